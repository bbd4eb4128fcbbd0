"""The cost of doubt: photographs that are hard to localize, or that cannot be, by processor time and outcome.

Question: how long does the server compute for a photograph of another place, for one of its own place that few matches
support, and for one that is turned, and which of them does it answer? Data: the scenes with known poses of a folder.
Photographs go through client, gRPC and a server of their own whose background work has ended
(`serving.py`), with the features that the environment sets, so that the same program measures the code of any commit:

`MAPLESS_FEATURES=auto MAPLESS_WEIGHTS_DIR=... python -m research.doubt WHAT SCENES --json FILE [--every N]`

`other-place` asks photographs of every place in the others (many more: `research.other_places`), `doubtful` asks those
of `doubtful.json`, which cost over two seconds when that list was made (`--list` makes it), `turned` asks photographs
turned about the optical axis (`evidence/turning.py`). `--store FOLDER` keeps the server's store, so
that a later run does not wait for the work in the background, which takes half an hour for all places; what is missing
of it is made, unless MAPLESS_BACKGROUND_MATCHING is false.
"""
