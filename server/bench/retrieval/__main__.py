"""`python -m bench.retrieval --references 1000000 [--data FOLDER]`."""

import typer

from .command import main

if __name__ == "__main__":
    typer.run(main)
