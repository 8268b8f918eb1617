#!/usr/bin/env python3
"""Turns what the chart renders into what `podman play kube` starts on one machine: pods, their Secret and volume.

    helm template photonfarm deploy/helm/photonfarm | python scripts/podman_pods.py > pods.yaml

A Deployment becomes its pods, and a Job one pod that is started again if it fails. What needs a cluster is left out,
and named on stderr. Needs PyYAML.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Iterable, Iterator
from typing import Any

import yaml

Document = dict[str, Any]

KEPT = ("Secret", "PersistentVolumeClaim")
"""Kinds that Podman takes as they are; it makes a secret and a volume of them."""


def podman_documents(documents: Iterable[Document], left_out: list[str]) -> Iterator[Document]:
    """The documents for Podman, in the same order; the names of the others are added to `left_out`."""
    for document in documents:
        kind, name = document["kind"], document["metadata"]["name"]
        if kind in KEPT:
            yield document
        elif kind == "Deployment":
            names = _pod_names(name, document["spec"].get("replicas", 1))
            yield from (_pod(pod, document["spec"]["template"], restart="Always") for pod in names)
        elif kind == "Job":
            yield _pod(name, document["spec"]["template"], restart="OnFailure")
        else:
            left_out.append(f"{kind}/{name}")


def _pod_names(name: str, replicas: int) -> list[str]:
    """The names of a Deployment's pods; a single one has its Deployment's, which is the host's name of its Service."""
    return [name] if replicas == 1 else [f"{name}-{number}" for number in range(replicas)]


def _pod(name: str, template: Document, restart: str) -> Document:
    """A pod of a template, as Podman 4.3 takes it."""
    spec = copy.deepcopy(template["spec"])
    spec["restartPolicy"] = restart
    for container in spec["containers"]:
        container.pop("ports", None)  # Podman would publish them to the world
        for mount in container["volumeMounts"]:
            mount["name"] = _volume_name(name, mount["name"], spec["volumes"])
    for volume in spec["volumes"]:
        volume["name"] = _volume_name(name, volume["name"], spec["volumes"])
    for volume in spec["volumes"]:
        if "secret" in volume:
            volume["secret"]["optional"] = False  # Podman 4.3 crashes where this is not said
    return {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": name, "labels": _labels(template)}, "spec": spec}


def _labels(template: Document) -> dict[str, str]:
    return dict(template["metadata"]["labels"])


def _volume_name(pod: str, name: str, volumes: list[Document]) -> str:
    """The name of a volume; Podman shares an emptyDir between all pods that have one of the same name."""
    return f"{pod}-{name}" if any(volume["name"] == name and "emptyDir" in volume for volume in volumes) else name


def main() -> None:
    """Read a rendered chart from stdin, and write it for Podman to stdout."""
    left_out: list[str] = []
    rendered = (document for document in yaml.safe_load_all(sys.stdin) if document)
    yaml.safe_dump_all(podman_documents(rendered, left_out), sys.stdout, sort_keys=False)
    if left_out:
        sys.stderr.write(f"left out, as they need a cluster: {', '.join(left_out)}\n")


if __name__ == "__main__":
    main()
