"""A gateway from HTTP to a server: `mapless-server gateway`.

    command > app > geopose > messages  (Open AR Cloud's GeoPose Protocol, version 2)
                  > plain    (one photograph as a form)
                  > rpc      (gRPC-Web and Connect, for browsers)
            > guard  (origins, size and number of requests)

It is a client like any other: a process of its own, which speaks gRPC to the server and stores nothing. `failures` has
the one form of its errors, `openapi` the description of what it serves. Begin reading with `app`.
"""
