"""A scene in the browser: its references, the points that were matched, and queries as they are answered.

    command > viewer > scenery (what there is, and how it is laid out)    > stage (what people see and do) > drawing
                     > feed (WatchQueries) > queries, pictures, meshes   -^

It is a client like any other: what it shows it has asked a server for. Only `stage`, `drawing` and `guarded`
know viser.
"""
