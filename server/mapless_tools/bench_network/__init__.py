"""`mapless-server bench-network`: what the networks cost, beside what the arithmetic costs at least.

Weights are random: time does not depend on them. `python -m mapless_tools.bench_network` is the same command without
the dependencies of the others; all of it but whole queries needs torch and NumPy alone.

    operations.py    counts operations and bytes, and predicts times from them
    subject.py       the networks, their weights and their inputs
    ceilings.py      what the device reaches
    forward.py       the network's forward pass, step by step
    variants.py      what else could be chosen: attention kernels, residual stream
    query.py         whole queries
    host.py          what can be measured without a CUDA device
    report.py        a table for people, JSON for programs, Markdown for BENCHMARKS.md
    command.py       all of it in order; what fails says so, and the rest goes on
"""
