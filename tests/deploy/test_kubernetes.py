"""Tests of `deploy/kubernetes`: manifests are rendered by kustomize, and checked against schemas and invariants."""

import gzip
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from ipaddress import ip_address, ip_network
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from service.settings import ServiceSettings

pytestmark = pytest.mark.slow
FOLDER = Path(__file__).resolve().parents[2] / "deploy" / "kubernetes"
SCHEMA = Path(__file__).with_name("schemas") / "raycluster_v1.schema.json.gz"
OVERLAYS = ("small", "gpu")
each_overlay = pytest.mark.parametrize("overlay", OVERLAYS)
#: Path where Kubernetes clients look for a token.
TOKEN = "/var/run/secrets/kubernetes.io/serviceaccount"
#: Secrets that operators have to create, according to the documentation.
SECRETS = {"sgsst-database", "sgsst-store", "sgsst-ray", "sgsst-tls"}


@cache
def rendered(overlay: str) -> str:
    return build(FOLDER / "overlays" / overlay)


def build(folder: Path) -> str:
    if shutil.which("kubectl"):
        command = ["kubectl", "kustomize"]
    elif shutil.which("kustomize"):
        command = ["kustomize", "build"]
    else:
        pytest.skip("neither kubectl nor kustomize is installed")
    ended = subprocess.run([*command, str(folder)], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert "deprecated" not in ended.stderr
    return ended.stdout


def objects(overlay: str) -> list[dict[str, Any]]:
    return [document for document in yaml.safe_load_all(rendered(overlay)) if document]


def of_kind(overlay: str, kind: str) -> list[dict[str, Any]]:
    return [each for each in objects(overlay) if each["kind"] == kind]


def pods(overlay: str) -> list[dict[str, Any]]:
    """Return the templates of all pods of an overlay."""
    templates = [each["spec"]["template"] for each in objects(overlay) if each["kind"] in ("Deployment", "Job")]
    for cluster in of_kind(overlay, "RayCluster"):
        templates.append(cluster["spec"]["headGroupSpec"]["template"])
        templates += [group["template"] for group in cluster["spec"]["workerGroupSpecs"]]
    return templates


def containers(overlay: str) -> list[dict[str, Any]]:
    return [
        container
        for pod in pods(overlay)
        for container in [*pod["spec"].get("initContainers", []), *pod["spec"]["containers"]]
    ]


@each_overlay
def test_manifests_match_their_schemas(overlay: str) -> None:
    validate = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is missing: see the extra [dev]")
    cluster_schema = json.loads(gzip.decompress(SCHEMA.read_bytes()))
    # the schema is that of a custom resource; Kubernetes adds the members common to all objects
    cluster_schema["properties"] |= {name: {} for name in ("apiVersion", "kind", "metadata")}
    for manifest in objects(overlay):
        if manifest["kind"] == "RayCluster":
            jsonschema.validate(manifest, cluster_schema)
        else:
            validate.validate(manifest, validate.latest_version(), strict=True)


@each_overlay
def test_pods_are_unprivileged_and_have_resource_limits(overlay: str) -> None:
    for pod in pods(overlay):
        assert pod["spec"]["securityContext"]["runAsNonRoot"] is True
        assert pod["spec"]["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["metadata"]["labels"]["app.kubernetes.io/part-of"] == "sgsst"
    for container in containers(overlay):
        context = container["securityContext"]
        assert context["allowPrivilegeEscalation"] is False, container["name"]
        assert context["capabilities"] == {"drop": ["ALL"]}, container["name"]
        assert context["readOnlyRootFilesystem"] is True, container["name"]
        written = {mount["mountPath"] for mount in container["volumeMounts"]}
        assert {"/data", "/tmp"} <= written, container["name"]
        assert {"cpu", "memory"} <= set(container["resources"]["requests"])
        assert "memory" in container["resources"]["limits"]
        mounted = {mount["name"] for mount in container["volumeMounts"]}
        named = [{volume["name"] for volume in pod["spec"]["volumes"]} for pod in pods(overlay)]
        assert any(mounted <= names for names in named)


@each_overlay
def test_only_the_autoscaler_has_a_kubernetes_token(overlay: str) -> None:
    accounts = of_kind(overlay, "ServiceAccount")
    assert accounts
    for account in accounts:
        assert account["automountServiceAccountToken"] is False
    names = {account["metadata"]["name"] for account in accounts}
    for pod in pods(overlay):
        assert pod["spec"]["automountServiceAccountToken"] is False
        assert pod["spec"]["serviceAccountName"] in names
    mounts = [mount["name"] for container in containers(overlay) for mount in container["volumeMounts"]]
    assert "token" not in mounts
    (cluster,) = of_kind(overlay, "RayCluster")
    if cluster["spec"].get("enableInTreeAutoscaling"):
        options, head = cluster["spec"]["autoscalerOptions"], cluster["spec"]["headGroupSpec"]["template"]["spec"]
        assert {"name": "token", "mountPath": TOKEN, "readOnly": True} in options["volumeMounts"]
        assert options["securityContext"] == containers(overlay)[0]["securityContext"]
        assert {mount["name"] for mount in options["volumeMounts"]} <= {volume["name"] for volume in head["volumes"]}
        assert head["serviceAccountName"] == "sgsst-autoscaler"


def policies_of(overlay: str) -> dict[str, dict[str, Any]]:
    return {each["metadata"]["name"]: each["spec"] for each in of_kind(overlay, "NetworkPolicy")}


def selected(overlay: str, policy: str) -> set[str]:
    """Return the names of the pods that a network policy selects."""
    selector = policies_of(overlay)[policy]["podSelector"]
    names = set()
    for labels in (pod["metadata"]["labels"] for pod in pods(overlay)):
        wanted = selector.get("matchLabels", {}).items() <= labels.items()
        for each in selector.get("matchExpressions", ()):
            assert each["operator"] == "In"
            wanted = wanted and labels.get(each["key"]) in each["values"]
        if wanted:
            names.add(labels["app.kubernetes.io/name"])
    return names


@each_overlay
def test_only_the_api_accepts_connections_from_outside(overlay: str) -> None:
    policies = policies_of(overlay)
    everything = {pod["metadata"]["labels"]["app.kubernetes.io/name"] for pod in pods(overlay)}
    assert selected(overlay, "sgsst-nobody") == everything
    assert policies["sgsst-nobody"]["policyTypes"] == ["Ingress", "Egress"]
    assert not {"ingress", "egress"} & policies["sgsst-nobody"].keys()
    assert {name for name, policy in policies.items() if "ingress" in policy} == {"sgsst-api", "sgsst-ray"}
    assert selected(overlay, "sgsst-api") == {"sgsst-api"}
    assert selected(overlay, "sgsst-ray") == everything - {"sgsst-api", "sgsst-prepare"}
    (way,) = policies["sgsst-ray"]["ingress"]
    assert way["from"] == [{"podSelector": policies["sgsst-ray"]["podSelector"]}]
    assert policies["sgsst-api"]["ingress"] == [{"ports": [{"protocol": "TCP", "port": 8000}]}]
    for service in of_kind(overlay, "Service"):
        assert service["spec"].get("type", "ClusterIP") == "ClusterIP"


@each_overlay
def test_pods_reach_only_what_they_need(overlay: str) -> None:
    """These are DNS, database, file store and Ray's other pods; with an autoscaler, also the Kubernetes API server."""
    policies = {name: spec for name, spec in policies_of(overlay).items() if "egress" in spec}
    (cluster,) = of_kind(overlay, "RayCluster")
    scales = bool(cluster["spec"].get("enableInTreeAutoscaling"))
    expected = {
        "sgsst-names": {53},
        "sgsst-database": {5432},
        "sgsst-store": {443},
        "sgsst-ray": set(),
        **({"sgsst-autoscaler": {443, 6443}} if scales else {}),
    }
    reached = {name: {port["port"] for port in spec["egress"][0].get("ports", ())} for name, spec in policies.items()}
    assert reached == expected
    assert policies["sgsst-ray"]["egress"] == [{"to": [{"podSelector": policies["sgsst-ray"]["podSelector"]}]}]
    assert selected(overlay, "sgsst-database") == {"sgsst-prepare", "sgsst-api", "sgsst-dispatcher"}
    assert selected(overlay, "sgsst-store") == selected(overlay, "sgsst-database") | {"sgsst-ray-worker"}
    if scales:
        assert selected(overlay, "sgsst-autoscaler") == {"sgsst-ray-head"}
    for spec in policies.values():
        (way,) = spec["egress"]
        for block in (each["ipBlock"] for each in way["to"] if "ipBlock" in each):
            credentials_of_the_cloud = "169.254.0.0/16" if "." in block["cidr"] else "fd00:ec2::/32"
            assert credentials_of_the_cloud in block["except"]


def changed(folder: Path, change: Callable[[dict[str, Any]], None]) -> list[dict[str, Any]]:
    """Return the objects of the overlay `gpu` after `change` has modified its kustomization, as an operator might."""
    shutil.copytree(FOLDER, folder / "kubernetes")
    overlay = folder / "kubernetes" / "overlays" / "gpu"
    kustomization = yaml.safe_load((overlay / "kustomization.yaml").read_text())
    change(kustomization)
    (overlay / "kustomization.yaml").write_text(yaml.safe_dump(kustomization))
    return [document for document in yaml.safe_load_all(build(overlay)) if document]


def test_webhooks_are_an_optional_component(tmp_path: Path) -> None:
    """The component enables webhooks and lets dispatchers reach all ports of public addresses, but no private ones."""
    for overlay in OVERLAYS:
        assert "SGSST_WEBHOOKS" not in rendered(overlay)
    manifests = changed(tmp_path, lambda overlay: overlay["components"].append("../../components/webhooks"))
    (settings,) = [each for each in manifests if each["kind"] == "ConfigMap"]
    assert settings["data"]["SGSST_WEBHOOKS"] == "true"
    (policy,) = [each for each in manifests if each["metadata"]["name"] == "sgsst-webhooks"]
    assert policy["spec"]["podSelector"]["matchLabels"] == {"app.kubernetes.io/name": "sgsst-dispatcher"}
    (way,) = policy["spec"]["egress"]
    blocks = [each["ipBlock"] for each in way["to"]]
    for address in ("10.1.2.3", "172.16.0.1", "192.168.1.1", "169.254.169.254", "127.0.0.1", "100.64.0.1", "fd00::1"):
        assert not any(_holds(block, address) for block in blocks), address
    for address in ("93.184.216.34", "2606:2800:220:1::1"):
        assert any(_holds(block, address) for block in blocks), address
    validate = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is missing: see the extra [dev]")
    validate.validate(policy, validate.latest_version(), strict=True)


def _holds(block: dict[str, Any], address: str) -> bool:
    parsed = ip_address(address)
    networks = [ip_network(block["cidr"]), *map(ip_network, block.get("except", ()))]
    return parsed in networks[0] and not any(parsed in network for network in networks[1:])


@each_overlay
def test_ray_requires_a_token_and_matches_the_installed_version(overlay: str) -> None:
    (cluster,) = of_kind(overlay, "RayCluster")
    assert cluster["spec"]["authOptions"] == {"mode": "token", "secretName": "sgsst-ray"}
    assert cluster["spec"]["rayVersion"] == version("ray")
    head = cluster["spec"]["headGroupSpec"]
    assert (head["rayStartParams"]["num-cpus"], head["rayStartParams"]["num-gpus"]) == ("0", "0")
    (dispatcher,) = [each for each in of_kind(overlay, "Deployment") if each["metadata"]["name"] == "sgsst-dispatcher"]
    assert dispatcher["spec"]["strategy"] == {"type": "Recreate"}
    name = f"{cluster['metadata']['name']}-head-svc:6379"  # the operator's name of the head's Service
    (node,) = [each for each in containers(overlay) if each["name"] == "ray-node"]
    assert f"--address={name}" in node["command"]
    (process,) = [each for each in containers(overlay) if each["name"] == "dispatcher"]
    assert {"name": "RAY_ADDRESS", "value": name} in process["env"]


def test_dispatchers_assign_no_more_gpus_than_the_cluster_has() -> None:
    (cluster,) = of_kind("gpu", "RayCluster")
    (group,) = cluster["spec"]["workerGroupSpecs"]
    (worker,) = group["template"]["spec"]["containers"]
    gpus = int(worker["resources"]["limits"]["nvidia.com/gpu"])
    (settings,) = of_kind("gpu", "ConfigMap")
    assert int(settings["data"]["SGSST_CLUSTER_GPUS"]) == group["maxReplicas"] * gpus
    assert cluster["spec"]["enableInTreeAutoscaling"] is True
    assert worker["image"].endswith("-cuda")
    images = {container["image"] for container in containers("gpu")} - {worker["image"]}
    assert len(images) == 1
    (memory,) = [each for each in group["template"]["spec"]["volumes"] if each["name"] == "memory"]
    assert memory["emptyDir"] == {"medium": "Memory", "sizeLimit": "16Gi"}


@each_overlay
def test_settings_and_secrets_exist_in_the_service(overlay: str) -> None:
    (settings,) = of_kind(overlay, "ConfigMap")
    known = {f"SGSST_{name.upper()}" for name in ServiceSettings.model_fields}
    assert {name for name in settings["data"] if name.startswith("SGSST_")} <= known
    text = rendered(overlay)
    named = set(re.findall(r"secretRef:\s+name: (\S+)", text)) | set(re.findall(r"secretName: (\S+)", text))
    named |= {
        each["valueFrom"]["secretKeyRef"]["name"]
        for c in containers(overlay)
        for each in c.get("env", [])
        if "valueFrom" in each
    }
    assert named <= SECRETS
    assert of_kind(overlay, "Secret") == []
