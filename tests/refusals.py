"""What is refused, and what is said of it."""

import pytest


def refused(said: str, call, *given, **named) -> str:
    """The text of the ValueError in which the call ends, which must match."""
    with pytest.raises(ValueError, match=said) as error:
        call(*given, **named)
    return str(error.value)
