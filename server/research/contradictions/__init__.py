"""Answers to photographs whose poses may contradict one another, before a change of the engine and after it.

Question: where several poses are found for a photograph, does the engine answer the right one, or none? Data: scenes
with known poses, in folders with `cameras.json`; of these, cases are made in which wrong poses are likely (`cases.py`).
Each case goes through client, gRPC and a server of its own (`asking.py`), by the public interface alone, so that the
same program measures the code of any commit:

`python -m research.contradictions SCENES --json AFTER.json [--only KIND ...] [--every N]` asks all cases, and
`python -m research.contradictions --compare BEFORE.json AFTER.json` prints what differs (`comparing.py`).
"""
