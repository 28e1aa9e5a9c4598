"""What every reader owes to a file that it cannot use: one printable line that names it."""

import pytest

from pdr_graph import InputError


def refused(load, path, message, *more):
    """Have `load` refuse a file, with a message that matches the pattern and names the file; return the message."""
    with pytest.raises(InputError, match=message) as refusal:
        load(path, *more)
    text = str(refusal.value)
    assert text.isprintable(), "one line"
    assert str(path) in text
    return text
