"""One HTML page of a walk or a day that needs nothing else: what was found, how sure it is, and why."""
