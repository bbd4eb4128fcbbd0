"""A query's way through the queue: decoding, choosing references, the stages of the method, stronger features.

May import scenes, store, security, method, networks, images and scheduling; it knows no gRPC and no message. Begin
with `engine.Engine`, then `stages`.
"""
