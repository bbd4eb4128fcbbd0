"""`python -m bench.load overhead|pipeline|soak|neighbours|all`."""

from .command import load_app

if __name__ == "__main__":
    load_app(prog_name="python -m bench.load")
