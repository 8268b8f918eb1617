"""The chart and the kustomize files, asked by the tools of Kubernetes, and run for real by Podman.

Each test is skipped where its tool is not found: on the PATH, or by the variables HELM, KUBECTL and PODMAN. Podman's
builds images and takes minutes, so it waits to be asked: make test-kubernetes.
"""

import functools
import importlib.util
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
CHART, KUSTOMIZE = ROOT / "deploy/helm/photonfarm", ROOT / "deploy/kustomize"
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
        "data": {"existingClaim": "disk"}, "scenes": {"existingClaim": "scenes"}, "redis": {"existingSecret": "mine"},
        "image": {"registry": "registry.example:5000/team", "pullSecrets": ["pull"]}, "trainer": {"enabled": False},
        "networkPolicy": {"extraEgress": [{"to": [{"ipBlock": {"cidr": "169.254.20.10/32"}}]}]},
    },
}  # fmt: skip
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


def tool(variable: str, program: str) -> Tool:
    """A program, which a variable names or the PATH has; skips the test without it."""
    found = shutil.which(os.environ.get(variable) or program)
    if found is None:
        pytest.skip(f"needs {program}: put it on the PATH, or name it in {variable} (docs/kubernetes.md)")

    def run(
        *args: str | Path, given: str | None = None, fails: bool | None = False
    ) -> subprocess.CompletedProcess[str]:
        """Run it; `fails` says whether it should fail, and None that it may."""
        done = subprocess.run([found, *map(str, args)], input=given, capture_output=True, text=True, timeout=1500)
        assert fails is None or (done.returncode != 0) == fails, f"{program} {args}: {done.stderr}"
        return done

    return run


@pytest.fixture
def helm() -> Tool:
    return tool("HELM", "helm")


@pytest.fixture
def kubectl() -> Tool:
    return tool("KUBECTL", "kubectl")


@pytest.fixture
def validated() -> Callable[[str], None]:
    """Checks documents against the schemas of the oldest and the newest Kubernetes; unknown fields are errors."""
    if importlib.util.find_spec("kubernetes_validate") is None:
        pytest.skip("needs kubernetes-validate: pip install -c constraints.txt -e 'shared[kubernetes]'")

    def validate(text: str) -> None:
        for version in (["-k", OLDEST], []):
            command = [sys.executable, "-W", "ignore", "-m", "kubernetes_validate", "--strict", *version, "-"]
            done = subprocess.run(command, input=text, capture_output=True, text=True)
            assert done.returncode == 0, done.stdout + done.stderr
            unknown = re.findall(r"find schema for kind (\w+)", done.stdout + done.stderr)
            assert set(unknown) <= {"ScaledObject", "TriggerAuthentication"}  # of KEDA

    return validate


def rendered(helm: Tool, values: dict[str, Any], release: str = "photonfarm") -> str:
    """What the chart makes of values."""
    given = json.dumps(values)
    return helm("template", release, CHART, "--namespace", "photonfarm", "--values", "-", given=given).stdout


def documents(text: str) -> dict[tuple[str, str], dict[str, Any]]:
    """The documents of a text by kind and name."""
    found = [document for document in yaml.safe_load_all(text) if document]
    return {(document["kind"], document["metadata"]["name"]): document for document in found}


# ---------------------------------------------------------------------------------------------------------------- Helm


@pytest.mark.parametrize("about", VALUES)
def test_the_chart_passes_lint_and_the_schemas_of_kubernetes(
    helm: Tool, validated: Callable[[str], None], tmp_path: Path, about: str
) -> None:
    (tmp_path / "values.yaml").write_text(json.dumps(VALUES[about]))
    helm("lint", "--strict", CHART, "--values", tmp_path / "values.yaml")
    text = rendered(helm, VALUES[about])
    validated(text)
    assert not re.findall(r"^ +$", text, re.MULTILINE)
    for (kind, name), document in documents(text).items():
        assert len(name) <= 63, kind
        assert document["metadata"]["labels"]["app.kubernetes.io/instance"] == "photonfarm"


@pytest.mark.parametrize("named", REFUSED)
def test_wrong_values_are_refused_by_their_name(helm: Tool, named: str) -> None:
    given = json.dumps(REFUSED[named])
    refused = helm("template", "photonfarm", CHART, "--values", "-", given=given, fails=True)
    assert named in refused.stderr


def test_a_store_in_a_bucket_needs_no_volume_but_that_of_the_run_and_a_way_out(helm: Tool) -> None:
    found = documents(rendered(helm, VALUES["bucket"]))
    renderer = found["Deployment", "photonfarm-renderer"]["spec"]["template"]["spec"]
    assert not [volume for volume in renderer["volumes"] if "persistentVolumeClaim" in volume]
    (container,) = renderer["containers"]
    assert container["envFrom"] == [{"secretRef": {"name": "keys"}}]
    variables = {variable["name"]: variable["value"] for variable in container["env"]}
    assert (variables["PHOTONFARM_STORE"], variables["PHOTONFARM_CACHE"]) == ("s3://farm/store", "/cache")
    out = found["NetworkPolicy", "photonfarm-farm"]["spec"]["egress"]
    assert [rule for rule in out if "to" not in rule] == [{"ports": [{"protocol": "TCP", "port": 443}]}]
    without = documents(rendered(helm, {**VALUES["bucket"], "trainer": {"enabled": False}}))
    assert ("PersistentVolumeClaim", "photonfarm-data") in found
    assert ("PersistentVolumeClaim", "photonfarm-data") not in without


def test_gpus_are_asked_for_and_several_of_them_train_by_torchrun(helm: Tool, parse) -> None:
    found = documents(rendered(helm, VALUES["GPUs"]))
    (renderer,) = found["Deployment", "photonfarm-renderer"]["spec"]["template"]["spec"]["containers"]
    assert renderer["resources"]["limits"] == {"memory": "9Gi", "nvidia.com/gpu": 1}
    variables = {variable["name"]: variable["value"] for variable in renderer["env"]}
    assert variables["PHOTONFARM_DEVICE"] == "cuda"
    with_card = yaml.safe_load((ROOT / "docker-compose.gpu.yml").read_text())["services"]["renderer"]["environment"]
    assert with_card.keys() <= variables.keys()
    may = [sorted(given["NVIDIA_DRIVER_CAPABILITIES"].split(",")) for given in (with_card, variables)]
    assert may[0] == may[1]
    assert with_card["OPTIX_CACHE_PATH"] == variables["OPTIX_CACHE_PATH"]
    ((_, job),) = [item for item in found.items() if item[0][0] == "Job"]
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
        return {name for kind, name in documents(rendered(helm, values)) if kind == "Job"}

    assert jobs() == jobs()
    (plan,) = jobs() - jobs(args=["--views", "2"])
    assert plan.startswith("photonfarm-plan-first-")


# ----------------------------------------------------------------------------------------------------------- kustomize


def test_the_files_for_kustomize_are_made_from_the_chart(helm: Tool) -> None:
    program = shutil.which(os.environ.get("HELM") or "helm")
    for path, text in runpy.run_path(str(ROOT / "scripts/kustomize_base.py"))["files"](program).items():
        assert path.read_text() == text, "run scripts/kustomize_base.py"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The folder as users have it: with a password."""
    shutil.copytree(KUSTOMIZE, tmp_path / "kustomize")
    (tmp_path / "kustomize/base/redis_password").write_text("secret\n")
    return tmp_path / "kustomize"


def test_kustomize_makes_of_its_files_what_kubernetes_takes(
    kubectl: Tool, validated: Callable[[str], None], checkout: Path
) -> None:
    text = kubectl("kustomize", checkout).stdout
    validated(text)
    found = documents(text)
    assert {document["metadata"]["namespace"] for document in found.values()} == {"photonfarm"}
    assert found["Secret", "photonfarm-redis"]["data"] == {
        "redis_password": "c2VjcmV0Cg==",
        "username": "cGhvdG9uZmFybQ==",
    }
    assert found["Deployment", "photonfarm-renderer"]["spec"]["replicas"] == 2


def test_kustomize_with_autoscaling_makes_what_the_chart_makes_with_it(
    helm: Tool, kubectl: Tool, validated: Callable[[str], None], checkout: Path
) -> None:
    settings = checkout / "kustomization.yaml"
    text, uncommented = re.subn(r"# - autoscaling.*", "- autoscaling", settings.read_text())
    assert uncommented == 1
    settings.write_text(re.sub(r"\npatches:.*", "", text, flags=re.DOTALL))
    made = kubectl("kustomize", checkout).stdout
    validated(made)
    by_chart = {without_digest(key): of for key, of in documents(rendered(helm, VALUES["autoscaling"])).items()}
    by_kustomize = documents(made)
    assert by_kustomize.keys() == by_chart.keys()
    for key, document in by_kustomize.items():
        if key[0] != "Secret":
            assert document["spec"] == by_chart[key]["spec"], key


def without_digest(key: tuple[str, str]) -> tuple[str, str]:
    kind, name = key
    return kind, re.sub(r"-[0-9a-f]{8}$", "", name) if kind == "Job" else name


# -------------------------------------------------------------------------------------------------------------- Podman

RELEASE = NETWORK = "photonfarm-test"
MODIFICATIONS = 48  # of which training holds out some
PLAN = ["--modifications", str(MODIFICATIONS), "--views", "1", "--shard-rows", "1"]
PODMAN_VALUES = {
    "plans": [{"name": "first", "spec": "room", "args": PLAN}],
    "trainer": {"spec": "room", "args": ["--steps", "4", "--batch", "4"]},
}


@pytest.fixture
def podman() -> Tool:
    if os.environ.get("PHOTONFARM_TEST_KUBERNETES") != "1":
        pytest.skip("builds images and takes minutes; run by: make test-kubernetes")
    return tool("PODMAN", "podman")


@pytest.fixture
def farm(helm: Tool, podman: Tool, tmp_path: Path) -> Iterator[dict[str, str]]:
    """The chart's pods, running; their containers, by what they do."""
    version = yaml.safe_load((CHART / "Chart.yaml").read_text())["appVersion"]
    for target in ("redis", "renderer", "trainer"):
        image = f"localhost/photonfarm/{target}:{version}"
        podman("build", "--network", "host", "--target", target, "--tag", image, ROOT)
    command, text = [sys.executable, str(ROOT / "scripts/podman_pods.py")], rendered(helm, PODMAN_VALUES, RELEASE)
    converted = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    print(podman("--version").stdout, converted.stderr, sep="")
    (tmp_path / "pods.yaml").write_text(converted.stdout)
    pods = {name: pod["spec"] for (kind, name), pod in documents(converted.stdout).items() if kind == "Pod"}
    containers = {
        name.removeprefix(f"{RELEASE}-"): f"{name}-{pod['containers'][0]['name']}" for name, pod in pods.items()
    }
    podman("network", "create", "--internal", NETWORK)
    try:
        podman("play", "kube", "--network", NETWORK, tmp_path / "pods.yaml")
        yield containers
    finally:
        print(podman("ps", "--all", "--pod").stdout)
        for container in containers.values():
            logs = podman("logs", container, fails=None)
            print(f"--- {container}", *(logs.stdout + logs.stderr).splitlines()[-8:], sep="\n")
        podman("play", "kube", "--down", tmp_path / "pods.yaml")
        podman("secret", "rm", f"{RELEASE}-redis")
        volumes = {volume["name"] for pod in pods.values() for volume in pod["volumes"]}
        podman("volume", "rm", "--force", *volumes - {"data", "password"}, f"{RELEASE}-data", f"{RELEASE}-redis")
        podman("network", "rm", NETWORK)


@pytest.mark.timeout(2400)
def test_the_pods_of_the_chart_complete_a_plan_and_train_on_it_under_podman(podman: Tool, farm: dict[str, str]) -> None:
    assert [part for part in farm if "renderer" in part] == ["renderer-0", "renderer-1"]
    renderers = [farm["renderer-0"], farm["renderer-1"]]
    status: dict[str, Any] = {}
    most = {"waiting": 0, "started": 0}
    deadline = time.monotonic() + 900
    while status.get("samples_complete") != MODIFICATIONS:
        assert time.monotonic() < deadline, {name: podman("logs", name).stderr for name in farm.values()}
        time.sleep(2)
        for name, length in lengths(podman, farm["redis"]).items():
            most[name] = max(most[name], length)
        status = status_of(podman, renderers[0])
    print(json.dumps({"most": most, "status": status}))
    assert most["waiting"] >= 1
    assert most["started"] == 2
    assert lengths(podman, farm["redis"]) == {"waiting": 0, "started": 0}

    markers = podman("exec", renderers[0], "sh", "-c", "cat /data/store/scenes/*/committed/*.json").stdout
    found = list(json_documents(markers))
    workers = {marker["figures"]["worker"] for marker in found}
    assert len(found) == MODIFICATIONS
    assert {worker.rpartition("-")[0] for worker in workers} == {f"{RELEASE}-renderer-0", f"{RELEASE}-renderer-1"}
    print(podman("exec", renderers[0], "photonfarm", "status").stdout)
    assert podman("exec", renderers[1], "photonfarm", "reconcile").stdout == "0 jobs queued\n"
    podman("exec", renderers[1], "photonfarm", "work", "--check")

    (plan,) = (container for part, container in farm.items() if part.startswith("plan-first"))
    (trainer,) = (container for part, container in farm.items() if part.startswith("trainer"))
    for job in (plan, trainer):
        assert podman("wait", job).stdout == "0\n"
    podman("exec", renderers[0], "test", "-s", "/data/run/checkpoint.safetensors")
    password = podman("exec", farm["redis"], "cat", "/run/photonfarm/redis_password").stdout.strip()
    assert len(password) >= 48  # Podman 4.3 leaves it in base64, for all pods alike
    for container in farm.values():
        assert_is_guarded(inspected(podman, container))
        logs = podman("logs", container)
        assert password not in logs.stdout + logs.stderr
    assert "NOAUTH" in podman("exec", farm["redis"], "redis-cli", "llen", "rq:queue:photonfarm").stdout
    for container in (renderers[0], farm["redis"]):
        assert password not in podman("exec", container, "sh", "-c", "cat /proc/[0-9]*/cmdline").stdout
        podman("exec", container, "touch", "/written", fails=True)

    podman("stop", "--time", "30", renderers[1])  # as process 1, without an init in front of it
    assert json.loads(podman("inspect", renderers[1]).stdout)[0]["State"]["ExitCode"] == 0


def status_of(podman: Tool, container: str) -> dict[str, Any]:
    """The status of the one scene; nothing before it is planned."""
    done = podman("exec", container, "photonfarm", "status", "--json", fails=None)
    scenes = json.loads(done.stdout)["scenes"] if done.returncode == 0 else []
    return scenes[0] if scenes else {}


def lengths(podman: Tool, container: str) -> dict[str, int]:
    """What KEDA would see, as its user and by a script, as it asks: `test_kubernetes_files` holds the names."""
    count = "local n = redis.call('TYPE', KEYS[1]).ok; return redis.call(n == 'zset' and 'ZCARD' or 'LLEN', KEYS[1])"
    keys = {"waiting": "rq:queue:photonfarm", "started": "rq:wip:photonfarm"}
    return {name: int(asked(podman, container, "EVAL", count, "1", key)) for name, key in keys.items()}


def asked(podman: Tool, container: str, *command: str) -> str:
    """What Redis answers to the user photonfarm."""
    script = 'redis-cli --user photonfarm --askpass "$@" < /run/photonfarm/redis_password'
    return podman("exec", container, "sh", "-c", script, "sh", *command).stdout.strip().splitlines()[-1]


def json_documents(text: str) -> Iterator[dict[str, Any]]:
    """JSON documents that stand one behind the other."""
    decoder, at = json.JSONDecoder(), 0
    while at < len(text.rstrip()):
        document, at = decoder.raw_decode(text, at)
        at = len(text) - len(text[at:].lstrip())
        yield document


@functools.cache
def inspected(podman: Tool, container: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(podman("inspect", container).stdout)[0]
    return found


def assert_is_guarded(container: dict[str, Any]) -> None:
    """It runs as nobody in particular, may do nothing in particular, and nobody outside reaches it."""
    host = container["HostConfig"]
    assert container["Config"]["User"].split(":")[0] == "1000"
    assert host["ReadonlyRootfs"]
    assert not host["Privileged"]
    assert not container["EffectiveCaps"]
    assert not container["BoundingCaps"]
    assert "no-new-privileges" in host["SecurityOpt"]
    assert not any((container["NetworkSettings"]["Ports"] or {}).values())
    assert not [name for name in container["Config"]["Env"] if "PASSWORD=" in name]
