"""Labels of scenes, by which they are grouped: value by name."""

import re
import unicodedata
from collections.abc import Iterable, Mapping

from . import names

MAX_LABELS, MAX_LABEL_VALUE = 32, 128
_NAME = re.compile("[A-Za-z0-9._-]{1,64}")


def check_labels(labels: Mapping[str, str]) -> dict[str, str]:
    """The labels, unchanged; ValueError for too many, or one whose name or value breaks the rules."""
    if len(labels) > MAX_LABELS:
        raise ValueError(f"must have at most {MAX_LABELS} labels, has {len(labels)}")
    for name, value in labels.items():
        if not _NAME.fullmatch(name):
            raise ValueError(f"must have names of 1 to 64 of A-Z a-z 0-9 . _ -, has {names.shown(name)}")
        if not 1 <= len(value) <= MAX_LABEL_VALUE or any(unicodedata.category(it) == "Cc" for it in value):
            bounds = f"1 to {MAX_LABEL_VALUE} characters, none of them a control character"
            raise ValueError(f"must have values of {bounds}, {name!r} has {names.shown(value)}")
    return dict(labels)


def parse_labels(texts: Iterable[str], flag: str = "--label") -> dict[str, str]:
    """Reads labels from texts NAME=VALUE; ValueError, with the flag, for another form, or two values of one name."""
    labels = dict[str, str]()
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise ValueError(f"{flag} takes NAME=VALUE, such as site=a, not {text!r}")
        if labels.setdefault(name, value) != value:
            raise ValueError(f"{flag} {name} is given as {labels[name]!r} and as {value!r}: no scene has both")
    try:
        return check_labels(labels)
    except ValueError as error:
        raise ValueError(f"{flag} {error}") from None
