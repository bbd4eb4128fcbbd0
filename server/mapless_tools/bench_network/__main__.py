"""The same command with only torch and NumPy, for a machine with a GPU and no other packages of the server."""

import argparse
import os

# As the server does, before NumPy is imported: threads of BLAS would wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from .command import OUTPUT, PARTS, bench_network

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measure the networks.")
    parser.add_argument("--quick", action="store_true", help="few repetitions, no compilation: to see that it runs")
    parser.add_argument("--only", action="append", choices=PARTS, help="a part to run; again for more; default: all")
    parser.add_argument("--output", default=OUTPUT, type=type(OUTPUT), help="folder for network.json and network.md")
    arguments = parser.parse_args()
    bench_network(arguments.quick, arguments.only, arguments.output)
