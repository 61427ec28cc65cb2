"""JSON from people, and JSON that is put into pages."""

import json
from typing import Any


def parse_json(text: str | bytes) -> Any:
    """Parse JSON that somebody else wrote.

    Raises:
        ValueError: it is not JSON, or is nested too deeply to be anything that we read.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def inert_json(value: Any) -> str:
    """JSON in which no text can end a script: the parameters of jobs stand in Snakemake's report."""
    return inert(json.dumps(value))


def inert(json_text: str) -> str:
    """The same JSON without `<`, which occurs in its texts alone."""
    return json_text.replace("<", "\\u003c")
