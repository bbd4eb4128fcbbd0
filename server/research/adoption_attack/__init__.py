"""Attacks on scenes that adopt: photographs of faked places, and what becomes of the answers to true ones."""
