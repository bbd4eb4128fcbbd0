"""Self-calibration: some references of a scene are localized against the others, in the background.

Begin with `fit` (the model), then `calibrator` (one scene) and `calibrations` (the scenes that wait). Results
are in `store.calibrations`.
"""
