"""Every call of the interface as an exchange: its request from values, its answer as values.

The clients' methods execute these functions and have their docstrings. Begin with localization.py.
"""
