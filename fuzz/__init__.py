"""Fuzzing: unexpected inputs, against what reads untrusted input.

A target is a module with a `TARGET`: seeds that are right, a mutator that knows their structure, and a check, which
says whether an input was accepted and raises where anything else happens than what is documented. `run` fuzzes one
target with atheris, guided by the coverage of our Python code; `campaign`, all of them; `plain` mutates without.
"""
