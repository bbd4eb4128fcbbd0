"""`python -m bench.network`: all parts but whole queries also where only torch and NumPy are installed."""

import argparse
import os
from importlib.util import find_spec
from pathlib import Path


def main() -> None:
    """Measures; a wrong argument or setting ends it with exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m bench.network", description="Measure the networks.")
    # As the server does, before NumPy is imported: threads of BLAS would wait for one another.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if find_spec("pydantic"):
        from mapless_server.serve.libraries import configure_libraries
        from mapless_server.settings import ConfigError, load_settings

        try:
            configure_libraries(load_settings({}).settings)
        except ConfigError as error:
            parser.error(str(error))

    from .command import OUTPUT, PARTS, bench_network

    parser.add_argument("--quick", action="store_true", help="few repetitions, no compilation: to see that it runs")
    parser.add_argument("--only", action="append", choices=PARTS, help="a part to run; again for more; default: all")
    parser.add_argument("--output", default=OUTPUT, type=Path, help="folder for network.json and network.md")
    given = parser.parse_args()
    bench_network(given.quick, given.only, given.output)


if __name__ == "__main__":
    main()
