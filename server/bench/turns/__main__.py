"""`python -m bench.turns BEFORE [AFTER] --what import --data FOLDER`."""

import typer

from .command import main

if __name__ == "__main__":
    typer.run(main)
