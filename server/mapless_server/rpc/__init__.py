"""What every call has in common: deadline, identity, errors, receiving, sending, log line.

May import observability, store, security and errors. Begin with `guard.CallGuard`, which wraps every handler.
"""
