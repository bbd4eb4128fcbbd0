"""The RPCs: messages to values, the engine's results to messages; one module a service.

May import rpc and what is below it. Begin with `localization`; `messages/` converts, `capture/` records calls for
replay, `watching` sends answers to the viewers of a scene, `handlers` registers all services with gRPC.
"""
