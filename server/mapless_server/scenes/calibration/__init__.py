"""What the references of a scene say of its answers: some are localized against the others, in the background.

Begin with `fit` (the model), then `calibrator` (one scene) and `calibrations` (the scenes that wait). Results
are in `store.calibrations`.
"""
