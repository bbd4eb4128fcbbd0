"""Keeping calls for a time, where the operator asks for it, and computing their answers again.

`calls` is what is kept of one, `folder` where, under a limit of time and one of size; `recorder` takes calls from the
services and hands them to the folder, in a thread of its own, and `deletion` sees to it that they go. `recompute`
answers a captured call anew, on the `stand_ins` of store and choice; `comparing` says what is different, and `report`
does so for a whole folder.
"""
