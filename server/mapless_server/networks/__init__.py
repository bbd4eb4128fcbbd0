"""The feed-forward 3D networks pi^3 (Wang et al. 2025), its successor Pi3X, and MapAnything (Keetha et al. 2025).

They are our own code, written from descriptions. A network takes images of one scene and computes, up to one
similarity, each view's pose and the point seen at each of its pixels. The modules' names are those of the official
checkpoints' entries. This room imports only `mapless_server.extras`, and this file imports nothing: torch takes
seconds. Begin with `network`, then `pi3`.

Pi3 and Pi3X are `encoder`, `decoder` (blocks within views and over the scene in turn), `heads` (poses, points and
confidence of decoded tokens; DPT) and `conditions` (rays, poses), put together in `pi3`; MapAnything is `encoder`,
`view_conditions` (any subset of the views) and `mapanything`; MegaLoc (Berton and Masone 2025) for retrieval is
`megaloc`. `runner` has one of them on a device, `checkpoint` reads its weights. `local_features` loads EdgePoint2
(`edgepoint2`), ALIKED, XFeat and SuperPoint, networks of other packages but for the first; `lightglue` matches them.
`weights` is the catalogue of weights, their folder, fetching and checking, without torch.
"""
