"""What the chart renders, read as YAML: it agrees with the compose file, the code, and itself.

`chart_rendered.yaml` holds what `helm template` prints, so these tests need no Helm. Where there is Helm,
test_kubernetes.py compares the file with the chart.
"""

import re
import tomllib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml
from redis import Redis

from photonfarm.farm.running_farm import METRICS_PORT
from photonfarm.queue.rq_adapter import open_queue

ROOT = Path(__file__).parents[2]
CHART = ROOT / "deploy/helm/photonfarm"
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]

DOCUMENTS: list[dict[str, Any]] = [*yaml.safe_load_all(Path(__file__).with_name("chart_rendered.yaml").read_text())]


def find_pod(document: dict[str, Any]) -> dict[str, Any] | None:
    """The template of a document's pods."""
    spec = document.get("spec", {})
    spec = spec["jobTemplate"]["spec"] if document["kind"] == "CronJob" else spec
    return spec.get("template")


def get_name(document: dict[str, Any]) -> str:
    """The name of a document; of a Job without the digest of what it runs."""
    name: str = document["metadata"]["name"]
    return re.sub(r"-[0-9a-f]{8}$", "", name) if document["kind"] == "Job" else name


PODS = {get_name(document): pod for document in DOCUMENTS if (pod := find_pod(document)) is not None}


def list_containers() -> Iterator[tuple[str, dict[str, Any]]]:
    """Every container, with the name of what runs it."""
    return ((name, container) for name, pod in PODS.items() for container in pod["spec"]["containers"])


def find(kind: str, name: str) -> dict[str, Any]:
    """One document."""
    (document,) = [d for d in DOCUMENTS if (d["kind"], get_name(d)) == (kind, name)]
    return document


def test_there_are_the_parts_of_the_farm_and_no_others() -> None:
    parts = ("metrics", "plan-first", "reconcile", "redis", "renderer", "trainer")
    assert set(PODS) == {f"photonfarm-{part}" for part in parts}


def test_the_images_are_those_of_the_compose_file_in_a_registry_that_nobody_has() -> None:
    ours = {service["image"] for service in COMPOSE["services"].values()}
    images = {container["image"] for _, container in list_containers()}
    assert images == {f"localhost/{image}:{VERSION}" for image in ours}
    assert yaml.safe_load((CHART / "Chart.yaml").read_text())["appVersion"] == VERSION


def test_every_command_and_probe_of_photonfarm_has_a_verb_and_options_that_there_are(parse) -> None:
    lines = [container["command"] for _, container in list_containers()]
    probes = [c[probe] for _, c in list_containers() for probe in c if probe.endswith("Probe")]
    lines += [probe["exec"]["command"] for probe in probes if "exec" in probe]
    ours = [line[1:] for line in lines if line[0] == "photonfarm"]
    assert len(ours) == len(PODS) - 1 + 2  # all but Redis, and two probes
    for arguments in ours:
        parse(arguments)


def test_variables_are_those_of_the_compose_file_and_on_the_page_of_the_configuration() -> None:
    page = (ROOT / "docs/configuration.md").read_text()
    wanted = {
        **COMPOSE["services"]["renderer"]["environment"],
        "PHOTONFARM_REDIS_URL": "redis://photonfarm-redis:6379/0",
    }
    for name, container in list_containers():
        variables = {variable["name"]: variable["value"] for variable in container["env"] if "value" in variable}
        assert variables == ({"REDIS_DATA": "/queue"} if name == "photonfarm-redis" else wanted)
    in_templates = "".join(path.read_text() for path in (CHART / "templates").iterdir())
    for variable in {*wanted, *re.findall(r"\bPHOTONFARM_\w+", in_templates)} - {"HOME"}:
        assert f"`{variable}`" in page, variable


@pytest.mark.parametrize("name", PODS)
def test_a_pod_is_nobody_in_particular_and_writes_to_nothing_but_its_volumes(name: str) -> None:
    spec = PODS[name]["spec"]
    assert spec["securityContext"]["runAsNonRoot"]
    assert spec["securityContext"]["runAsUser"] == spec["securityContext"]["fsGroup"] == 1000
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert spec["automountServiceAccountToken"] is False
    for container in spec["containers"]:
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert "memory" in container["resources"]["limits"]
        volumes = {volume["name"]: volume for volume in spec["volumes"]}
        mounts = {mount["mountPath"]: mount for mount in container["volumeMounts"]}
        assert {mount["name"] for mount in mounts.values()} == set(volumes)
        assert {path for path, mount in mounts.items() if not mount.get("readOnly")} <= {"/tmp", "/data", "/queue"}
        assert volumes["tmp"]["emptyDir"]["sizeLimit"]
        password = volumes[mounts["/run/photonfarm"]["name"]]["secret"]
        assert (password["secretName"], password["items"][0]["path"]) == ("photonfarm-redis", "redis_password")


def test_the_network_policies_cover_every_pod_and_let_the_farm_reach_nothing_but_redis_and_names() -> None:
    redis, farm = (find("NetworkPolicy", f"photonfarm-{part}")["spec"] for part in ("redis", "farm"))
    component = "app.kubernetes.io/component"
    metrics = find("NetworkPolicy", "photonfarm-metrics")["spec"]
    covered = farm["podSelector"]["matchExpressions"][0]["values"]
    labels = {name: pod["metadata"]["labels"] for name, pod in PODS.items()}
    assert {label[component] for label in labels.values()} == {"redis", *covered}
    for label in labels.values():
        assert farm["podSelector"]["matchLabels"].items() <= label.items()
    assert redis["podSelector"]["matchLabels"] == labels["photonfarm-redis"]
    assert redis["policyTypes"] == farm["policyTypes"] == ["Ingress", "Egress"]
    assert "egress" not in redis
    assert "ingress" not in farm
    (entry,) = redis["ingress"]
    keda = {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "keda"}}}
    assert entry["from"] == [{"podSelector": farm["podSelector"]}, keda]
    to_redis, names = farm["egress"]
    assert to_redis["to"] == [{"podSelector": redis["podSelector"]}]
    assert {port["port"] for port in names["ports"]} == {53}
    assert metrics["podSelector"]["matchLabels"] == labels["photonfarm-metrics"]
    assert (metrics["policyTypes"], "egress" in metrics) == (["Ingress"], False)
    (entry,) = metrics["ingress"]
    namespaces = {"matchLabels": {"kubernetes.io/metadata.name": "monitoring"}}
    assert entry == {"from": [{"namespaceSelector": namespaces}], "ports": [{"protocol": "TCP", "port": "metrics"}]}


def test_metrics_are_answered_by_the_names_that_a_prometheus_of_the_cluster_asks_by(parse) -> None:
    """The server answers to no other name: by the Service's, or the pod's address where pods are found one by one."""
    service, (container,) = (
        find("Service", "photonfarm-metrics"),
        PODS["photonfarm-metrics"]["spec"]["containers"],
    )
    arguments = container["command"][1:]
    parse(arguments)
    names = {value for option, value in pairwise(arguments) if option == "--name"}
    assert names >= {"photonfarm-metrics", "photonfarm-metrics.photonfarm.svc", "$(POD_IP)"}
    assert {"name": "POD_IP", "valueFrom": {"fieldRef": {"fieldPath": "status.podIP"}}} in container["env"]
    assert service["spec"]["selector"].items() <= PODS["photonfarm-metrics"]["metadata"]["labels"].items()
    assert [port["port"] for port in service["spec"]["ports"]] == [METRICS_PORT]
    assert container["ports"] == [{"name": service["spec"]["ports"][0]["targetPort"], "containerPort": METRICS_PORT}]
    page = (ROOT / "docs/kubernetes.md").read_text()
    assert f"farm-photonfarm-metrics.farm.svc:{METRICS_PORT}" in page


def test_keda_watches_the_queue_and_the_started_jobs_of_the_redis_that_there_is(connection: Redis) -> None:
    scaled, access = (
        find(*of) for of in (("ScaledObject", "photonfarm-renderer"), ("TriggerAuthentication", "photonfarm-redis"))
    )
    jobs = open_queue(connection)
    watched = [trigger["metadata"]["listName"] for trigger in scaled["spec"]["triggers"]]
    assert watched == [jobs.key, jobs.started_job_registry.key]
    assert find("Deployment", scaled["spec"]["scaleTargetRef"]["name"])
    service = find("Service", "photonfarm-redis")
    for trigger in scaled["spec"]["triggers"]:
        assert trigger["metadata"]["address"] == "photonfarm-redis.photonfarm.svc:6379"
        assert trigger["authenticationRef"]["name"] == access["metadata"]["name"]
    assert service["spec"]["ports"][0]["port"] == 6379
    keys = {entry["parameter"]: entry["key"] for entry in access["spec"]["secretTargetRef"]}
    assert keys == {"username": "username", "password": "redis_password"}
    assert scaled["spec"]["minReplicaCount"] == 0
    assert find("CronJob", "photonfarm-reconcile"), "nothing would wake the workers again"
