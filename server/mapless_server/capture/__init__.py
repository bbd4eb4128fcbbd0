"""Keeping calls for a time, where the operator asks for it, and computing their answers again.

`calls` is what is kept of one, `folder` where, under a limit of time and one of size; `recorder` takes calls from the
services and hands them to the folder, in a thread of its own. `recorded`, `replaying` and `comparing` compute an answer
anew from what was kept, and say what is different.
"""
