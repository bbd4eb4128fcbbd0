"""How an operator sees the server: metrics and their port, the log, traces. Nothing here decides anything.

May import engine, scenes, store, security, method, networks, images and scheduling. Begin with `metrics.Metrics`, which
has every metric; `logs` formats the log, `call_record` is what is recorded of one call, `tracing` and `otlp` send it to
a collector, and `exporter` is the HTTP port of metrics and probes. Modules are imported one by one: the log is needed
before the environment of numerical libraries is set, and OpenTelemetry only where traces are wanted.
"""
