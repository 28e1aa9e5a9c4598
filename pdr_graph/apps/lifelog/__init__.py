"""The days: recordings of many days and people, the walks, rides and stays in them, and the places they were at."""
