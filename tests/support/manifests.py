"""Kubernetes manifests as kustomize builds them, and the pods in them."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]

Json = dict[str, Any]

DEPLOY = Path(__file__).parents[2] / "deploy"
COMPONENTS = DEPLOY / "kubernetes" / "components"
KUBECTL = shutil.which("kubectl", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
needs_kubectl = pytest.mark.skipif(KUBECTL is None, reason="kubectl, which has kustomize, is not here")


@dataclass(frozen=True)
class Pod:
    """A pod that a manifest makes.

    Attributes:
        kind: of what makes it.
        template: its metadata and spec.
        claims: names of the volumes that are claimed for it.
    """

    kind: str
    template: Json
    claims: frozenset[str] = frozenset()

    @property
    def labels(self) -> dict[str, str]:
        return dict(self.template["metadata"]["labels"])

    @property
    def spec(self) -> Json:
        return dict(self.template["spec"])

    @property
    def container(self) -> Json:
        """The only one."""
        (found,) = self.spec["containers"]
        return dict(found)

    @property
    def ports(self) -> dict[str, int]:
        return {it["name"]: it["containerPort"] for it in self.container.get("ports", ())}


@cache
def built(name: str) -> tuple[Json, ...]:
    """The manifests that `kubectl apply -k` of "folder+component+component", below deploy, would send."""
    folder, *components = name.split("+")
    with TemporaryDirectory() as made:
        up = Path(*[".."] * (len(Path(made).resolve().parts) - 1))
        kustomization = {
            "apiVersion": "kustomize.config.k8s.io/v1beta1",
            "kind": "Kustomization",
            "resources": [str(up / (DEPLOY / folder).relative_to("/"))],
            "components": [str(up / (COMPONENTS / it).relative_to("/")) for it in components],
        }
        (Path(made) / "kustomization.yaml").write_text(yaml.safe_dump(kustomization))
        assert KUBECTL is not None
        command = [KUBECTL, "kustomize", made]
        text = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    return tuple(document for document in yaml.safe_load_all(text) if document)


def of_kind(documents: tuple[Json, ...], *kinds: str) -> list[Json]:
    return [document for document in documents if document["kind"] in kinds]


def pods(documents: tuple[Json, ...]) -> Iterator[Pod]:
    """All pods, also those of KubeRay's clusters."""
    for document in of_kind(documents, "StatefulSet", "Deployment", "Job"):
        claims = frozenset(it["metadata"]["name"] for it in document["spec"].get("volumeClaimTemplates", ()))
        yield Pod(document["kind"], document["spec"]["template"], claims)
    for document in of_kind(documents, "RayService"):
        cluster = document["spec"]["rayClusterConfig"]
        for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
            yield Pod("RayService", group["template"])
