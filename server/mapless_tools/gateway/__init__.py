"""A gateway from HTTP to a server: `mapless-server gateway`.

    command > app > geopose > messages  (Open AR Cloud's GeoPose Protocol, version 2)
                  > plain    (one photograph as a form)
                  > rpc      (gRPC-Web and Connect, for browsers)
            > guard  (origins, size and number of requests)

It is a client like any other: a separate process, which calls the server by gRPC and stores nothing. `guard` has the
form of its errors, too, `openapi` the description of its interface. Begin with `app`.
"""
