"""Every call of the interface as an exchange: its request from values, its answer as values.

The clients' methods are these functions, driven; their docstrings are the methods'.
"""
