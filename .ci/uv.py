"""Runs uv with the package sources that pip is configured to use, since uv reads no configuration of pip's.

Usage: PYTHON_OF_AN_ENVIRONMENT .ci/uv.py pip install ...
"""

import ast
import os
import subprocess
import sys
from pathlib import Path

# pip's option: uv's variable, and what separates its values.
VARIABLES = {
    "index-url": ("UV_DEFAULT_INDEX", " "),
    "extra-index-url": ("UV_INDEX", " "),
    "find-links": ("UV_FIND_LINKS", ","),
    "cert": ("SSL_CERT_FILE", " "),
}


def main() -> None:
    """Replaces this process by uv."""
    listed = subprocess.run([sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True)
    # uv takes the first index that has a package, pip the best version of all; uv does so too with this option.
    environment = {"UV_INDEX_STRATEGY": "unsafe-best-match"}
    # Variables override files.
    for line in sorted(listed.stdout.splitlines(), key=lambda it: it.startswith(":env:")):
        name, _, value = line.partition("=")
        variable, separator = VARIABLES.get(name.rpartition(".")[2], ("", ""))
        if variable:
            environment[variable] = separator.join(ast.literal_eval(value).split())
    uv = str(Path(sys.executable).parent / "uv")
    os.execve(uv, [uv, *sys.argv[1:]], environment | os.environ | {"VIRTUAL_ENV": sys.prefix})


main()
