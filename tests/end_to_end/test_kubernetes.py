"""The chart, rendered by Helm and held against the schemas of Kubernetes.

The tests are skipped where Helm is not found: on the PATH, or by the variable HELM.
"""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
CHART = ROOT / "deploy/helm/photonfarm"
OLDEST = re.search(r'kubeVersion: ">=(\d+\.\d+)', (CHART / "Chart.yaml").read_text())[1]  # type: ignore[index]

Tool = Callable[..., subprocess.CompletedProcess[str]]

BUCKET = {"url": "s3://farm/store", "secret": "keys"}
GPU = {"runtimeClass": "nvidia", "nodeSelector": {"gpu": "a100"}, "tolerations": [{"key": "gpu", "operator": "Exists"}]}
VALUES: dict[str, dict[str, Any]] = {
    "defaults": {},
    "autoscaling": {"autoscaling": {"enabled": True}, "plans": [{"name": "first", "spec": "room"}]},
    "bucket": {"bucket": BUCKET, "plans": [{"name": "a", "spec": "room"}, {"name": "b", "spec": "cornell"}]},
    "GPUs": {"renderer": {"gpus": 1, **GPU}, "trainer": {"gpus": 4, **GPU, "spec": "room"}, "bucket": BUCKET},
    "metrics": {"metrics": {"enabled": True, "prometheusNamespace": "watch"}, "bucket": BUCKET},
    "all ours": {
        "data": {"existingClaim": "disk"},
        "scenes": {"existingClaim": "scenes"},
        "redis": {"existingSecret": "mine"},
        "image": {"registry": "registry.example:5000/team", "pullSecrets": ["pull"]},
        "trainer": {"enabled": False},
        "networkPolicy": {"extraEgress": [{"to": [{"ipBlock": {"cidr": "169.254.20.10/32"}}]}]},
    },
}
"""Values that should be taken, by what they are about."""

REFUSED: dict[str, dict[str, Any]] = {
    "additional properties 'renderers'": {"renderers": 3},
    "/renderer/replicas": {"renderer": {"replicas": -1}},
    "/renderer/gpus": {"renderer": {"gpus": 2}},
    "/user/uid": {"user": {"uid": 0}},
    "/bucket/url": {"bucket": {"url": "/data/store"}},
    "/plans/0/args/1": {"plans": [{"name": "first", "spec": "room", "args": ["--modifications", 64]}]},
    "/plans/0/name": {"plans": [{"name": "First", "spec": "room"}]},
    "/image/registry": {"image": {"registry": ""}},
    "autoscaling.minReplicas = 9": {"autoscaling": {"enabled": True, "minReplicas": 9, "maxReplicas": 8}},
    "/reconcile/enabled": {"autoscaling": {"enabled": True}, "reconcile": {"enabled": False}},
}
"""Values that should be refused, by what the message names."""


@pytest.fixture
def helm() -> Tool:
    """Helm, which the variable HELM names or the PATH has; skips the test without it."""
    program = shutil.which(os.environ.get("HELM") or "helm")
    if program is None:
        pytest.skip("needs helm: put it on the PATH, or name it in HELM (docs/kubernetes.md)")

    def run(*args: str | Path, given: str | None = None, fails: bool = False) -> subprocess.CompletedProcess[str]:
        """Run it; `fails` says whether it should fail."""
        command = [program, *map(str, args)]
        done = subprocess.run(command, input=given, capture_output=True, text=True, cwd=ROOT, timeout=60)
        assert (done.returncode != 0) == fails, f"{command}: {done.stderr}"
        return done

    return run


@pytest.fixture
def validated() -> Callable[[str], None]:
    """Checks documents against the schemas of the oldest and the newest Kubernetes; unknown fields are errors."""
    if importlib.util.find_spec("kubernetes_validate") is None:
        pytest.skip("needs kubernetes-validate: pip install -c constraints.txt --group kubernetes")

    def validate(text: str) -> None:
        for version in (["-k", OLDEST], []):
            command = [sys.executable, "-W", "ignore", "-m", "kubernetes_validate", "--strict", *version, "-"]
            done = subprocess.run(command, input=text, capture_output=True, text=True)
            assert done.returncode == 0, done.stdout + done.stderr
            unknown = re.findall(r"find schema for kind (\w+)", done.stdout + done.stderr)
            assert set(unknown) <= {"ScaledObject", "TriggerAuthentication"}  # of KEDA

    return validate


def render(helm: Tool, values: dict[str, Any], release: str = "photonfarm") -> str:
    """What the chart makes of values."""
    given = json.dumps(values)
    return helm("template", release, CHART, "--namespace", "photonfarm", "--values", "-", given=given).stdout


def parse_documents(text: str) -> dict[tuple[str, str], dict[str, Any]]:
    """The documents of a text by kind and name."""
    parsed = [document for document in yaml.safe_load_all(text) if document]
    return {(document["kind"], document["metadata"]["name"]): document for document in parsed}


# ---------------------------------------------------------------------------------------------------------------- Helm


@pytest.mark.parametrize("about", VALUES)
def test_the_chart_passes_lint_and_the_schemas_of_kubernetes(
    helm: Tool, validated: Callable[[str], None], tmp_path: Path, about: str
) -> None:
    (tmp_path / "values.yaml").write_text(json.dumps(VALUES[about]))
    helm("lint", "--strict", CHART, "--values", tmp_path / "values.yaml")
    text = render(helm, VALUES[about])
    validated(text)
    assert not re.findall(r"^ +$", text, re.MULTILINE)
    for (kind, name), document in parse_documents(text).items():
        assert len(name) <= 63, kind
        assert document["metadata"]["labels"]["app.kubernetes.io/instance"] == "photonfarm"


@pytest.mark.parametrize("named", REFUSED)
def test_wrong_values_are_refused_by_their_name(helm: Tool, named: str) -> None:
    given = json.dumps(REFUSED[named])
    refused = helm("template", "photonfarm", CHART, "--values", "-", given=given, fails=True)
    assert named in refused.stderr


def test_a_store_in_a_bucket_needs_no_volume_but_that_of_the_run_and_a_way_out(helm: Tool) -> None:
    documents = parse_documents(render(helm, VALUES["bucket"]))
    renderer = documents["Deployment", "photonfarm-renderer"]["spec"]["template"]["spec"]
    assert not [volume for volume in renderer["volumes"] if "persistentVolumeClaim" in volume]
    (container,) = renderer["containers"]
    assert container["envFrom"] == [{"secretRef": {"name": "keys"}}]
    variables = {variable["name"]: variable["value"] for variable in container["env"]}
    assert (variables["PHOTONFARM_STORE"], variables["PHOTONFARM_CACHE"]) == ("s3://farm/store", "/cache")
    out = documents["NetworkPolicy", "photonfarm-farm"]["spec"]["egress"]
    assert [rule for rule in out if "to" not in rule] == [{"ports": [{"protocol": "TCP", "port": 443}]}]
    without = parse_documents(render(helm, {**VALUES["bucket"], "trainer": {"enabled": False}}))
    assert ("PersistentVolumeClaim", "photonfarm-data") in documents
    assert ("PersistentVolumeClaim", "photonfarm-data") not in without


def test_gpus_are_asked_for_and_several_of_them_train_by_torchrun(helm: Tool, parse) -> None:
    documents = parse_documents(render(helm, VALUES["GPUs"]))
    (renderer,) = documents["Deployment", "photonfarm-renderer"]["spec"]["template"]["spec"]["containers"]
    assert renderer["resources"]["limits"] == {"memory": "9Gi", "nvidia.com/gpu": 1}
    variables = {variable["name"]: variable["value"] for variable in renderer["env"]}
    assert variables["PHOTONFARM_DEVICE"] == "cuda"
    with_card = yaml.safe_load((ROOT / "docker-compose.gpu.yml").read_text())["services"]["renderer"]["environment"]
    assert with_card.keys() <= variables.keys()
    may = [sorted(given["NVIDIA_DRIVER_CAPABILITIES"].split(",")) for given in (with_card, variables)]
    assert may[0] == may[1]
    assert with_card["OPTIX_CACHE_PATH"] == variables["OPTIX_CACHE_PATH"]
    ((_, job),) = [item for item in documents.items() if item[0][0] == "Job"]
    spec = job["spec"]["template"]["spec"]
    assert spec["runtimeClassName"] == "nvidia"
    (trainer,) = spec["containers"]
    assert trainer["resources"]["limits"]["nvidia.com/gpu"] == 4
    assert trainer["command"][:5] == ["torchrun", "--nproc-per-node", "4", "--no-python", "--"]
    parse(trainer["command"][6:])
    assert {"name": "shm", "mountPath": "/dev/shm"} in trainer["volumeMounts"]


def test_a_job_that_is_changed_has_another_name_and_one_that_is_not_keeps_it(helm: Tool) -> None:
    def jobs(**plan: Any) -> set[str]:
        values = {"plans": [{"name": "first", "spec": "room", **plan}]}
        return {name for kind, name in parse_documents(render(helm, values)) if kind == "Job"}

    assert jobs() == jobs()
    (plan,) = jobs() - jobs(args=["--views", "2"])
    assert plan.startswith("photonfarm-plan-first-")


ALL_PARTS = (
    "autoscaling.enabled=true,metrics.enabled=true,plans[0].name=first,plans[0].spec=room,"
    "redis.existingSecret=photonfarm-redis"
)
"""Values with which the chart makes everything but a Secret, whose password is another each time."""


def test_what_is_kept_of_the_chart_for_tests_without_helm_is_what_it_renders(helm: Tool) -> None:
    command = ("template", "photonfarm", "deploy/helm/photonfarm", "--namespace", "photonfarm", "--set", ALL_PARTS)
    kept = Path(__file__).with_name("chart_rendered.yaml")
    made = helm(*command).stdout
    assert kept.read_text() == made, f"helm {' '.join(command[:-1])} '{ALL_PARTS}' > {kept.relative_to(ROOT)}"
