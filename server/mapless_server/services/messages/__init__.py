"""Conversion of requests to values and of values to responses; errors name the field of the request.

May import what `services` may. Begin with `queries` (a request to a Query) and `answers` (a Result to a response);
`priors`, `groups`, `references` and `debug` convert what their names say; `radii` calibrates the radii of an answer.
"""
