"""The adapter to Ray Serve: each replica is a whole mapless server without a socket of its own.

May import the client and the server. Begin with `app.build`, the application of a Serve config; `replica` is one
replica, `ingress` puts mapless's handlers on Serve's gRPC server, `scaling` is the autoscaling policy, and
`environment` has the variables that Ray is started with. No module of mapless imports this package.
"""
