"""What is refused, and what is said of it."""

import pytest


def refused(said: str, call, *given, **named) -> None:
    """The call ends in a ValueError whose text matches."""
    with pytest.raises(ValueError, match=said):
        call(*given, **named)
