"""The RPCs: requests become values for the engine and the store, and their results become responses.

May import rpc and what is below it. Begin with `localization`, the LocalizationService; `references` is the
ReferenceService, for which `adding` describes and stores new references. `messages/` converts requests and responses,
`watching` sends answers to the watchers of a scene, `capture/` records calls for replay, and `handlers` registers all
services with gRPC.
"""
