"""Kubernetes manifests: what kustomize makes of them, whether they are valid, and whether pods are confined."""

import shutil
import subprocess
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import kubernetes_validate  # type: ignore[import-untyped]
import pytest
import yaml  # type: ignore[import-untyped]

Json = dict[str, Any]

OLDEST = "1.31"
"""The oldest Kubernetes that the manifests are checked against."""
VERSIONS = (OLDEST, kubernetes_validate.latest_version())
CONFINED = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}}
"""The security context of a container."""
needs_kubectl = pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl, which has kustomize, is not here")


@cache
def built(folder: Path) -> tuple[Json, ...]:
    """What `kubectl apply -k` would send."""
    command = ["kubectl", "kustomize", str(folder)]
    text = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    return tuple(document for document in yaml.safe_load_all(text) if document)


def check_valid(documents: Iterable[Json]) -> None:
    """All are resources of the oldest and the newest Kubernetes, in the namespace, and none is a secret."""
    for document in documents:
        if document["kind"] != "RayService":  # KubeRay's
            for version in VERSIONS:
                kubernetes_validate.validate(document, version, strict=True)
        assert document["kind"] != "Secret"
        assert document["kind"] == "Namespace" or document["metadata"]["namespace"] == "mapless"


def check_confined(pod: Json) -> None:
    """The pod's user and its containers have no rights."""
    security = pod["securityContext"]
    assert security["runAsNonRoot"] is True
    assert security["runAsUser"] == 10001
    assert security["seccompProfile"] == {"type": "RuntimeDefault"}
    assert all(container["securityContext"] == CONFINED for container in pod["containers"])
