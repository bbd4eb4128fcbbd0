"""`python -m bench.network`: the networks' times, with the least time that their arithmetic needs.

Weights are random: time does not depend on them. All parts except whole queries need only torch and NumPy.

Begin with `command`. `subject` has the networks, their weights and inputs, `operations` the least time for them,
`forward` the pass step by step and the device's memory, `query` whole queries (`planted`), `report` the tables.
"""
