"""The common parts of all calls: deadline, identity, errors, receiving, sending, and the line in the log.

May import observability and everything below it. Begin with `guard.CallGuard`, which wraps every handler: it makes the
`call.Call`, has `receiving` read its message and `sending` write its messages, and turns errors into statuses.
"""

from .call import Call
from .guard import CLIENT_ID_KEY, Authenticate, CallGuard
from .sending import REQUEST_ID_KEY, to_status
