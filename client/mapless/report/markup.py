"""Elements of a page: escaped text, numbers with units, tables.

All external text passes through `text`.
"""

import math
from collections.abc import Iterable, Sequence
from html import escape

UNKNOWN = "-"


def text(value: object) -> str:
    """Anything as text of a page, or of an attribute in double quotes."""
    return escape(str(value), quote=True)


def number(value: float) -> str:
    """Coordinates of a drawing: a hundredth is finer than any screen."""
    return f"{value:.2f}".rstrip("0").rstrip(".") if math.isfinite(value) else "0"


def length(metres: float) -> str:
    """A length in a unit that suits its size."""
    if not math.isfinite(metres):
        return UNKNOWN
    size = abs(metres)
    if size < 0.01:
        return f"{1000 * metres:.2g} mm" if size < 0.001 else f"{1000 * metres:.1f} mm"
    if size < 1:
        return f"{100 * metres:.1f} cm"
    return f"{metres:.2f} m" if size < 100 else f"{metres:,.0f} m"


def angle(degrees: float) -> str:
    """An angle, finer where it is small."""
    if not math.isfinite(degrees):
        return UNKNOWN
    return f"{degrees:.3f}°" if abs(degrees) < 0.1 else f"{degrees:.2f}°" if abs(degrees) < 10 else f"{degrees:.0f}°"


def duration(seconds: float) -> str:
    """A duration."""
    return f"{1000 * seconds:.0f} ms" if seconds < 1 else f"{seconds:.2f} s"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table of cells, which are markup; all columns but the first are right-aligned."""
    cells = "".join(f"<th>{text(it)}</th>" for it in head)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    top = f"<thead><tr>{cells}</tr></thead>" if head else ""
    return f'<div class="wide"><table class="{kind}">{top}<tbody>{body}</tbody></table></div>'


def section(title: str, *parts: str) -> str:
    """A section of the non-empty parts; empty if there are none."""
    filled = [part for part in parts if part]
    return f"<section><h2>{text(title)}</h2>{''.join(filled)}</section>" if filled else ""


def reference_id(name: str) -> str:
    """The id in a reference's name."""
    return name.rpartition("/")[2]
