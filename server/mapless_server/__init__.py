"""The mapless server."""


def __getattr__(name: str) -> str:
    """`__version__`, read from the installed package when first asked for, since that takes 40 ms."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    found = globals()[name] = version("mapless")
    return found
