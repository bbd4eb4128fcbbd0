"""What operators see of the server: metrics and their port, the log, and traces. Nothing here changes an answer.

May import engine, scenes, store, security, method, networks, images and scheduling. Begin with `metrics.Metrics`, which
has every metric; `logs` formats the log, `tracing` records one call, `otlp` sends these records to a collector,
and `exporter` is the HTTP port of metrics and probes. Modules are imported one by one: the log is needed before the
environment of numerical libraries is set, and OpenTelemetry only where traces are wanted.
"""
