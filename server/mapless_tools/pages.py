"""HTML reports: one file each, that needs nothing else and runs no scripts."""

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, **values: object) -> str:
    """A page of `templates/`, with `values` for its names; text is escaped."""
    environment = Environment(
        loader=PackageLoader("mapless_tools"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
