"""The gateway's HTTP interface: the paths and their handlers."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from mapless import MaplessError, Rejected
from mapless.aio import Client
from mapless.names import parse_scene_name, scene_name

from . import geopose, openapi, plain
from .guard import Failure, Guard, GuardOptions, of_server

_SENT_HEADERS = (
    "authorization",
    "connect-protocol-version",
    "connect-timeout-ms",
    "content-type",
    "grpc-timeout",
    "x-client-id",
    "x-grpc-web",
    "x-mapless-scene",
    "x-request-id",
    "x-user-agent",
)
"""Headers that browsers may send besides those that they always may."""
_READ_HEADERS = (
    "grpc-message",
    "grpc-status",
    "grpc-status-details-bin",
    "retry-after",
    "x-mapless-scene",
    "x-request-id",
)
_PREFLIGHT_S = 7200
T = TypeVar("T")


@dataclass(frozen=True)
class GatewayOptions:
    """Options of the gateway: where requests that name no scene are localized, and a folder of pages for "/".

    That is a scene, or without one all scenes with these labels; by the GeoPose Protocol only those with a datum.
    """

    scene: str = ""
    group: Mapping[str, str] = field(default_factory=dict)
    pages: Path | None = None
    guard: GuardOptions = field(default_factory=GuardOptions)


def gateway(connect: Callable[[], Client], options: GatewayOptions, rpc: ASGIApp) -> ASGIApp:
    """Makes the application.

    `connect` makes the client, and is called when the event loop runs. `rpc` is the application for browsers' calls, at
    the paths of gRPC.
    """
    handlers = _Handlers(connect, options)
    routes: list[BaseRoute] = [
        Route("/geopose", handlers.status, methods=["GET"]),
        Route("/geopose", handlers.geopose, methods=["POST"]),
        Route("/scenes/{scene}/geopose", handlers.status, methods=["GET"]),
        Route("/scenes/{scene}/geopose", handlers.geopose, methods=["POST"]),
        Route("/v1/localize", handlers.localize, methods=["POST"]),
        Route("/openapi.json", handlers.description, methods=["GET"]),
        Route("/docs", handlers.page, methods=["GET"]),
        *(Mount(f"/mapless.v1.{service}", rpc) for service in ("LocalizationService", "ReferenceService")),
    ]
    if options.pages is not None:
        routes.append(Mount("/", StaticFiles(directory=options.pages, html=True)))
    cors = Middleware(
        CORSMiddleware,
        allow_origins=options.guard.origins,
        allow_methods=["GET", "POST"],
        allow_headers=_SENT_HEADERS,
        expose_headers=_READ_HEADERS,
        max_age=_PREFLIGHT_S,
    )
    errors: dict[Any, Any] = {404: _not_found, 405: _not_allowed}
    return Guard(Starlette(routes=routes, middleware=[cors], exception_handlers=errors), options.guard)


def _handler(handle: "Callable[[_Handlers, Request], Awaitable[Response]]") -> "Callable[[_Handlers, Request], Any]":
    """Answers errors with their JSON; here, so that pages of other origins can read them."""

    @wraps(handle)
    async def handled(self: "_Handlers", request: Request) -> Response:
        try:
            return await handle(self, request)
        except Failure as failure:
            return failure.response()
        except MaplessError as error:
            return of_server(error).response()
        except ClientDisconnect:  # nobody reads it
            return Failure("the request ended before its end", reason="DISCONNECTED").response()

    return handled


@dataclass
class _Handlers:
    connect: Callable[[], Client]
    options: GatewayOptions
    _client: Client | None = None

    def _client_for(self, request: Request) -> Client:
        if self._client is None:
            self._client = self.connect()
        given, identity = request.headers.get("authorization"), request.headers.get("x-client-id", "")
        if given is None and not identity:
            return self._client
        token = self._client.options.token
        if given is not None:
            scheme, _, token = given.partition(" ")
            if scheme.lower() != "bearer":
                raise Failure("must be: Bearer TOKEN", 401, reason="UNAUTHENTICATED", field="authorization")
        try:
            return self._client.acting_for(token, identity)
        except ValueError as error:
            if str(error).startswith("client_id"):
                raise Failure(str(error), field="x-client-id") from None
            raise Failure(str(error), 401, reason="UNAUTHENTICATED", field="authorization") from None

    def _scene_of(self, request: Request) -> str:
        """The name of the scene of a request; empty for any of the gateway's group."""
        scene = request.path_params.get("scene", self.options.scene)
        if not scene:
            return ""
        try:
            parse_scene_name(name := scene_name(scene))
        except ValueError as error:
            raise Failure(str(error), field="scene") from None
        return name

    @_handler
    async def status(self, request: Request) -> Response:
        if not await self._client_for(request).is_serving():
            raise Failure("the server does not serve", 503, reason="UNAVAILABLE", retry_after_s=1.0)
        return JSONResponse({"status": "running"})

    @_handler
    async def geopose(self, request: Request) -> Response:
        geopose.check_version(request.headers.get("accept", ""))
        client, scene = self._client_for(request), self._scene_of(request)
        body = b"".join([part async for part in request.stream()])  # `request.body()` would keep it
        datum = (await client.get_scene(scene)).datum if scene else None
        if scene and datum is None:
            raise Failure(
                f"{scene} has no datum, so its poses have no place on the Earth", 409, reason="NO_DATUM", field="scene"
            )
        photograph = await asyncio.to_thread(geopose.read, body, datum)
        del body
        try:
            localizing = client.localize(
                photograph.image,
                photograph.camera,
                scene,
                group=None if scene else self.options.group,
                with_datum=not scene,
                priors=photograph.priors,
                confidential=photograph.is_confidential,
            )
            answer = await _while_connected(request, localizing)
        except MaplessError as error:
            name, dot, rest = (error.field or "").partition(".")
            raise of_server(error, photograph.prior_fields.get(name, name) + dot + rest) from None
        if isinstance(answer, Rejected):
            hint = answer.hint.message if answer.hint else None
            request_id = answer.diagnostics.request_id
            raise Failure(answer.message, 422, reason=answer.reason, hint=hint, request_id=request_id)
        response = geopose.response_to(photograph, answer)
        return JSONResponse(response, media_type=geopose.MEDIA_TYPE, headers={"x-mapless-scene": answer.scene})

    @_handler
    async def localize(self, request: Request) -> Response:
        client = self._client_for(request)
        asked = await plain.read_form(request.headers, request.stream())
        if not (asked.scene or asked.scenes or asked.HasField("scene_group")):
            if self.options.scene:
                asked.scene = scene_name(self.options.scene)
            else:
                asked.scene_group.SetInParent()
                asked.scene_group.labels.update(self.options.group)
        response = await _while_connected(request, client.call("Localize", asked, lambda it: it))
        return JSONResponse(await asyncio.to_thread(plain.to_json, response))

    async def description(self, request: Request) -> Response:
        return JSONResponse(openapi.description())

    async def page(self, request: Request) -> Response:
        return HTMLResponse(openapi.page())


async def _while_connected(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """The result of a call, which is cancelled if its caller leaves, with `ClientDisconnect`."""
    task = asyncio.ensure_future(work)

    async def watch() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass
        task.cancel()

    watching = asyncio.ensure_future(watch())
    try:
        return await task
    except asyncio.CancelledError:
        if watching.done():
            raise ClientDisconnect from None
        task.cancel()
        raise
    finally:
        watching.cancel()


async def _not_found(request: Request, error: Exception) -> Response:
    return Failure(f"nothing is served at {request.url.path[:200]!a}", 404, reason="NOT_FOUND").response()


async def _not_allowed(request: Request, error: Exception) -> Response:
    message = f"{request.url.path[:200]!a} does not take {request.method[:20]!a}"
    return Failure(message, 405, reason="METHOD_NOT_ALLOWED").response()
