"""Conversion of requests to values and of values to responses; errors name the field of the request.

May import what `services` may. Begin with `queries` (a request and its priors to a Query) and `answers` (a Result to a
response, with calibrated radii); `groups`, `references` and `debug` convert what their names say.
"""
