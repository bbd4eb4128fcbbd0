"""Every call of the interface as a coroutine on a connection: its request from values, its answer as values.

The clients' methods execute these functions and have their docstrings. Begin with localization.py; rigs and sequences
are in groups.py.
"""
