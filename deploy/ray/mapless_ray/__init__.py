"""mapless on Ray Serve: replicas that each are a whole mapless server but for the socket.

`app.build` makes the application of a Serve config, `replica` is what one replica is, `ingress` puts mapless's
handlers on the gRPC server that Serve opens in it, and `scaling` says how many replicas there should be. Nothing of
mapless knows of this package.
"""
