"""An exchange without a server, with a clock that the test sets."""

from typing import Any

from mapless.errors import MaplessError
from mapless.exchange import Attempt, Call, Exchange, Pause, _Clock, attempts
from mapless.options import ConnectOptions


class Played:
    """An exchange with scripted outcomes; the last is repeated.

    Attributes:
        tries: the time left to each attempt, seconds.
        pauses: seconds.
        took_s: all of them together with the attempts, which take a second each.
        result: what it returned, or its error.
    """

    def __init__(
        self, exchange: Exchange[Any], outcomes: list[Any], options: ConnectOptions, dice: float = 0.5
    ) -> None:
        self.tries: list[float] = []
        self.calls: list[Call] = []
        self.pauses: list[float] = []
        self.took_s = 0.0
        clock = _Clock(lambda: self.took_s, lambda low, high: low + dice * (high - low))
        steps = attempts(exchange, options, clock)
        outcomes = list(outcomes)
        try:
            step = next(steps)
            while True:
                if isinstance(step, Pause):
                    self.pauses.append(step.duration_s)
                    self.took_s += step.duration_s
                    step = next(steps)
                else:
                    assert isinstance(step, Attempt)
                    self.tries.append(step.timeout_s)
                    self.calls.append(step.call)
                    self.took_s += 1.0
                    step = steps.send(outcomes.pop(0) if len(outcomes) > 1 else outcomes[0])
        except StopIteration as end:
            self.result: Any = end.value
        except MaplessError as error:
            self.result = error
