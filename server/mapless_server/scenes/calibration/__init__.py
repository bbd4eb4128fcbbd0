"""Self-calibration: some references of a scene are localized against the others, in the background.

Begin with `fit` (the model), then `lens` (errors of the intrinsics that all share) and `calibrator` (one scene, and the
scenes that wait). Results are in `store.calibrations`.
"""
