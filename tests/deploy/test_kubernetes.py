"""`deploy/kubernetes`: rendered by kustomize, against the schemas of Kubernetes and KubeRay, and what must hold."""

from __future__ import annotations

import gzip
import json
import re
import shutil
import subprocess
from functools import cache
from importlib.metadata import version
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
#: Secrets and their keys that the docs ask for.
SECRETS = {"sgsst-database", "sgsst-store", "sgsst-ray", "sgsst-tls"}


@cache
def rendered(overlay: str) -> str:
    if shutil.which("kubectl"):
        command = ["kubectl", "kustomize"]
    elif shutil.which("kustomize"):
        command = ["kustomize", "build"]
    else:
        pytest.skip("neither kubectl nor kustomize is installed")
    ended = subprocess.run([*command, str(FOLDER / "overlays" / overlay)], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert "deprecated" not in ended.stderr
    return ended.stdout


def objects(overlay: str) -> list[dict[str, Any]]:
    return [found for found in yaml.safe_load_all(rendered(overlay)) if found]


def of_kind(overlay: str, kind: str) -> list[dict[str, Any]]:
    return [found for found in objects(overlay) if found["kind"] == kind]


def pods(overlay: str) -> list[dict[str, Any]]:
    """Templates of all pods."""
    found = [each["spec"]["template"] for each in objects(overlay) if each["kind"] in ("Deployment", "Job")]
    for cluster in of_kind(overlay, "RayCluster"):
        found.append(cluster["spec"]["headGroupSpec"]["template"])
        found += [group["template"] for group in cluster["spec"]["workerGroupSpecs"]]
    return found


def containers(overlay: str) -> list[dict[str, Any]]:
    return [
        container
        for pod in pods(overlay)
        for container in [*pod["spec"].get("initContainers", []), *pod["spec"]["containers"]]
    ]


@each_overlay
def test_manifests_keep_to_the_schemas(overlay: str) -> None:
    validate = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is missing: see the extra [dev]")
    cluster_schema = json.loads(gzip.decompress(SCHEMA.read_bytes()))
    # the schema is that of a custom resource: Kubernetes adds the members that every object has
    cluster_schema["properties"] |= {name: {} for name in ("apiVersion", "kind", "metadata")}
    for found in objects(overlay):
        if found["kind"] == "RayCluster":
            jsonschema.validate(found, cluster_schema)
        else:
            validate.validate(found, validate.latest_version(), strict=True)


@each_overlay
def test_a_mistake_is_one_to_the_schemas(overlay: str) -> None:
    validate = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is missing: see the extra [dev]")
    (cluster,) = of_kind(overlay, "RayCluster")
    cluster["spec"]["headGroupSpec"]["template"]["spec"]["container"] = []
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(cluster["spec"], json.loads(gzip.decompress(SCHEMA.read_bytes()))["properties"]["spec"])
    deployment = of_kind(overlay, "Deployment")[0]
    deployment["spec"]["replica"] = 3
    with pytest.raises(validate.ValidationError):
        validate.validate(deployment, validate.latest_version(), strict=True)


@each_overlay
def test_pods_have_no_rights_and_know_their_size(overlay: str) -> None:
    for pod in pods(overlay):
        assert pod["spec"]["securityContext"]["runAsNonRoot"] is True
        assert pod["spec"]["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["metadata"]["labels"]["app.kubernetes.io/part-of"] == "sgsst"
    for container in containers(overlay):
        context = container["securityContext"]
        assert context["allowPrivilegeEscalation"] is False, container["name"]
        assert context["capabilities"] == {"drop": ["ALL"]}, container["name"]
        # KubeRay writes to the root of the containers that it starts
        assert context.get("readOnlyRootFilesystem") or container["name"].startswith("ray-"), container["name"]
        assert {"cpu", "memory"} <= set(container["resources"]["requests"])
        assert "memory" in container["resources"]["limits"]
        mounted = {mount["name"] for mount in container["volumeMounts"]}
        named = [{volume["name"] for volume in pod["spec"]["volumes"]} for pod in pods(overlay)]
        assert any(mounted <= names for names in named)


@each_overlay
def test_only_the_api_can_be_reached(overlay: str) -> None:
    policies = {each["metadata"]["name"]: each["spec"] for each in of_kind(overlay, "NetworkPolicy")}
    labels = [pod["metadata"]["labels"] for pod in pods(overlay)]

    def selected(policy: str) -> set[str]:
        wanted = policies[policy]["podSelector"]["matchLabels"].items()
        return {found["app.kubernetes.io/name"] for found in labels if wanted <= found.items()}

    everything = {found["app.kubernetes.io/name"] for found in labels}
    assert selected("sgsst-nobody") == everything
    assert "ingress" not in policies["sgsst-nobody"]
    assert selected("sgsst-api") == {"sgsst-api"}
    assert selected("sgsst-ray") == everything - {"sgsst-api", "sgsst-prepare"}
    (way,) = policies["sgsst-ray"]["ingress"]
    assert way["from"] == [{"podSelector": policies["sgsst-ray"]["podSelector"]}]
    assert policies["sgsst-api"]["ingress"] == [{"ports": [{"protocol": "TCP", "port": 8000}]}]
    for service in of_kind(overlay, "Service"):
        assert service["spec"].get("type", "ClusterIP") == "ClusterIP"


@each_overlay
def test_ray_asks_for_a_token_and_is_of_the_version_that_is_installed(overlay: str) -> None:
    (cluster,) = of_kind(overlay, "RayCluster")
    assert cluster["spec"]["authOptions"] == {"mode": "token", "secretName": "sgsst-ray"}
    assert cluster["spec"]["rayVersion"] == version("ray")
    head = cluster["spec"]["headGroupSpec"]
    assert (head["rayStartParams"]["num-cpus"], head["rayStartParams"]["num-gpus"]) == ("0", "0")
    (dispatcher,) = [each for each in of_kind(overlay, "Deployment") if each["metadata"]["name"] == "sgsst-dispatcher"]
    assert dispatcher["spec"]["strategy"] == {"type": "Recreate"}
    name = f"{cluster['metadata']['name']}-head-svc:6379"  # how the operator calls the head's Service
    (node,) = [each for each in containers(overlay) if each["name"] == "ray-node"]
    assert f"--address={name}" in node["command"]
    (process,) = [each for each in containers(overlay) if each["name"] == "dispatcher"]
    assert {"name": "RAY_ADDRESS", "value": name} in process["env"]


def test_gpus_that_dispatchers_give_out_are_those_that_there_can_be() -> None:
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
def test_settings_and_secrets_are_those_that_the_service_has(overlay: str) -> None:
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


def test_the_api_stays_up_while_it_is_replaced() -> None:
    (api,) = [each for each in of_kind("gpu", "Deployment") if each["metadata"]["name"] == "sgsst-api"]
    assert api["spec"]["replicas"] == 2
    assert api["spec"]["strategy"]["rollingUpdate"] == {"maxSurge": 1, "maxUnavailable": 0}
    (budget,) = of_kind("gpu", "PodDisruptionBudget")
    assert budget["spec"]["selector"] == {"matchLabels": {"app.kubernetes.io/name": "sgsst-api"}}
    assert budget["spec"]["minAvailable"] == 1
    (ingress,) = of_kind("gpu", "Ingress")
    assert ingress["spec"]["tls"]
    assert ingress["metadata"]["annotations"]["nginx.ingress.kubernetes.io/proxy-body-size"] == "0"
