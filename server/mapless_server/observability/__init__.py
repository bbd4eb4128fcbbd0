"""The operators' view of the server: metrics and their port, the log, and traces. Nothing here changes an answer.

May import engine, scenes, store, security, method, networks, images and scheduling. Begin with `metrics.Metrics`, which
has every metric; `logs` formats the log, `otlp` records calls and sends the records to a collector, `event_loop`
measures delays, and `exporter` is the HTTP port of metrics and probes. Modules are imported one by one: the log is
needed before the environment of numerical libraries is set, and OpenTelemetry only where traces are wanted.
"""
