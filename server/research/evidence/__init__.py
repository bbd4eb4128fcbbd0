"""Measures constants again and writes their pages, `docs/evidence/KEY.md`: `python -m research.evidence KEY`."""
