"""`python -m bench.network`: the networks' times, with the least time that their arithmetic needs.

Weights are random: time does not depend on them. All parts except whole queries need only torch and NumPy.

    operations.py    counts operations, and the least time for them
    subject.py       the networks, their weights and their inputs, and what is counted of them
    forward.py       the network's forward pass, step by step; the device's limits and memory
    query.py         whole queries, on a network whose answer is replaced by the truth (planted.py)
    report.py        a table for people, JSON for programs, Markdown
    command.py       all of it in order; begin reading here
"""
