"""A query's way through the queue: decoding, choosing references, the stages of the method, stronger features.

May import scenes, store, security, method, networks, images and scheduling; it knows no gRPC and no message. Begin with
`queue_engine.QueueEngine`, which the services call; `query` has what goes in and comes out, `photos` a photograph with
its features, `stages` the way of a query, `tiers` when stronger features are tried, `groups` rigs and sequences.
"""
