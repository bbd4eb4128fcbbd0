"""Compiled code for what numpy computes slowly, each beside a plain version with the same result, to rounding.

May import numpy alone. Begin with `nearest`. A module that is not compiled, or not for this processor, costs time only.
"""
