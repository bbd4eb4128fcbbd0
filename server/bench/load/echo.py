"""The simplest gRPC server in Python, as a program: grpc.aio, bytes in, bytes out."""

import asyncio
import signal
import sys
from typing import Any

import grpc

from .sender import MAX_MESSAGE_BYTES

ECHO_METHOD = "/mapless.load.Bare/Echo"
SHORT_METHOD = "/mapless.load.Bare/Short"
REFUSED_METHOD = "/mapless.load.Bare/Refused"
SHORT_BYTES = 300
"""Length of the answers of `Short`: about that of an answer of the server that computes nothing."""


async def main(max_message_bytes: int) -> None:
    """Listens on a free port and serves until SIGTERM."""

    async def echo(data: bytes, _: object) -> bytes:
        return data

    async def short(data: bytes, _: object) -> bytes:
        return data[:SHORT_BYTES]

    async def refused(_: object, context: Any) -> None:
        await context.abort(grpc.StatusCode.UNAUTHENTICATED, "refused")

    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    server = grpc.aio.server(options=[("grpc.max_receive_message_length", max_message_bytes)])
    service, _, _ = ECHO_METHOD[1:].partition("/")
    methods = {"Echo": grpc.unary_unary_rpc_method_handler(echo), "Short": grpc.unary_unary_rpc_method_handler(short)}
    methods["Refused"] = grpc.stream_unary_rpc_method_handler(refused)  # whose message is not read
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service, methods),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    print(f"mapless-server listening on 127.0.0.1:{port}", flush=True)
    await stop.wait()
    await server.stop(1.0)


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]) if sys.argv[1:] else MAX_MESSAGE_BYTES))
