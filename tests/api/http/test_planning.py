"""Tests of dry runs that report their progress."""

import json
from typing import Any

import httpx2
import pytest

from tests.api.http.sending import refused
from tests.api.service import Service, wait_for

#: Region that freezes every Gaussian in view, but not those at the corners of the wall.
IN_VIEW = {"name": "middle", "select": "sphere=0,0,3,2.5", "freeze": True}
PARAMETERS = {"preset": "preview", "backbone": "vgg16", "resolution": 128}


def request(files: dict[str, bytes], **parameters: Any) -> dict[str, Any]:
    names = {"scene": "scene.ply", "cameras": "cameras.json", "style": "style.png"}
    return {
        "params": {"dry_run": True},
        "files": [(role, (names[role], content)) for role, content in files.items()],
        "data": {"parameters": json.dumps(PARAMETERS | parameters)},
    }


def jobs(client: httpx2.Client) -> list[str]:
    return [job["id"] for job in client.get("/v1/jobs").json()["jobs"]]


def events(client: httpx2.Client, files: dict[str, bytes], **parameters: Any) -> list[httpx2.ServerSentEvent]:
    with client.sse("/v1/jobs", method="POST", **request(files, **parameters)) as source:
        assert source.response.status_code == 200, source.response.read()
        return [sent for sent in source if sent.data]


def test_estimate_covers_the_whole_job(client: httpx2.Client, files: dict[str, bytes]) -> None:
    plan = client.post("/v1/jobs", **request(files)).json()
    assert plan["warnings"] == []
    expected = plan["plan"]["prediction"]
    assert plan["total_seconds"] > expected["job"] + expected["ending"] > plan["estimated_seconds"] > 0
    limited = client.post("/v1/jobs", **request(files, within=0.001)).json()
    (chosen,) = (each for each in limited["plan"]["decisions"] if each["item"] == "time budget")
    assert chosen["decision"].endswith(" 1 step")
    assert limited["pixels"] < plan["pixels"], "those of the chosen views"


def test_views_and_regions_without_gaussians_are_warned_about(client: httpx2.Client, files: dict[str, bytes]) -> None:
    aside = json.loads(files["cameras"])
    aside[0]["position"] = [0, 0, 99]
    regions = [{"name": "empty", "select": "half-space=0,0,-1,-99"}, {"name": "all", "select": "half-space=0,0,1,-99"}]
    sent = request({**files, "cameras": json.dumps(aside).encode()}, regions=regions)
    warnings = client.post("/v1/jobs", **sent).json()["warnings"]
    assert "views: 1 of 3 are skipped: they see no Gaussian" in warnings
    assert any(text.startswith("region empty: ignored, because it has no Gaussians") for text in warnings)
    assert len(warnings) == 2


def test_unusable_files_are_rejected_before_first_event(client: httpx2.Client, files: dict[str, bytes]) -> None:
    headers = {"Accept": "text/event-stream"}
    refused(client.post("/v1/jobs", headers=headers, **request({**files, "scene": b"none"})), 422, "invalid-scene")


def test_planning_errors_are_events(client: httpx2.Client, files: dict[str, bytes]) -> None:
    last = events(client, files, regions=[IN_VIEW])[-1]
    problem = json.loads(last.data)
    assert (last.event, problem["status"], problem["code"]) == ("problem", 422, "invalid-settings")
    plain = client.post("/v1/jobs", **request(files, regions=[IN_VIEW]))
    assert (plain.status_code, plain.json()) == (422, problem)


def test_mismatched_cameras_are_rejected_immediately(client: httpx2.Client, files: dict[str, bytes]) -> None:
    frame = {"file_path": "a.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    stereo = json.dumps({"camera_model": "VR180_L", "camera_angle_x": 1, "w": 64, "h": 32, "frames": [frame]}).encode()
    for name, content, detail in (
        ("transforms.json", stereo, "which is neither a pinhole with a lens nor a 360-degree panorama"),
        ("cameras.xml", b"<?xml version='1.0'?>", "It may be cameras of Metashape."),
        ("reconstruction.json", b'[{"cameras": {}, "shots": {}}]', "export_colmap"),
    ):
        asked = request(files)
        asked["files"][1] = ("cameras", (name, content))
        assert detail in refused(client.post("/v1/jobs", **asked), 422, "invalid-cameras")["detail"]


@pytest.mark.slow
def test_disconnect_cancels_planning(service: Service, client: httpx2.Client, files: dict[str, bytes]) -> None:
    """A thousand views take several times as long to plan as a client takes to disconnect at the first event."""
    views = json.loads(files["cameras"])
    many = [{**views[index % len(views)], "img_name": f"view_{index}"} for index in range(1000)]
    long = request({**files, "cameras": json.dumps(many).encode()}, resolution=1024, seed=1)
    events(client, files)
    both = len(service.processes("service.inspection.process"))
    with client.sse("/v1/jobs", method="POST", **long) as source:
        next(iter(source))
    wait_for(lambda: len(service.processes("service.inspection.process")) < both, "the planning process to end")
    assert events(client, files, resolution=96)[-1].event == "plan"


def test_plan_of_an_orbit_says_whether_up_is_sure(client: httpx2.Client, files: dict[str, bytes]) -> None:
    without = {role: content for role, content in files.items() if role != "cameras"}
    before = jobs(client)
    asked = client.post("/v1/jobs", **request(without, orbit=2)).json()["up"]
    assert (asked["sure"], len(asked["candidates"])) == (False, 2)
    assert asked["candidates"][0] == "-y"
    assert "most captures" in asked["reason"]
    answer = client.post("/v1/jobs", **request(without) | {"params": {"sure_up": True}})  # an orbit by default
    assert refused(answer, 422, "unsure-up")["candidates"] == asked["candidates"]
    assert jobs(client) == before
    given = client.post("/v1/jobs", **request(without, orbit=2, up="z")).json()["up"]
    assert given == {"direction": "z", "sure": True, "candidates": ["z"], "reason": "requested"}
    assert client.post("/v1/jobs", **request(files)).json()["up"] is None


def test_cameras_that_hardly_show_the_scene_are_refused_if_asked(
    client: httpx2.Client, files: dict[str, bytes]
) -> None:
    views = json.loads(files["cameras"])
    for view in views:
        view["position"][0] += 3.2  # the wall ends at 2.4
    foreign = {**files, "cameras": json.dumps(views).encode()}
    before = jobs(client)
    refused = client.post("/v1/jobs", **request(foreign) | {"params": {"sure_up": True}})
    assert (refused.status_code, refused.json()["code"], refused.json()["input"]) == (
        422,
        "unsure-cameras",
        "cameras",
    )
    assert "of the Gaussians in its frame" in refused.json()["detail"]
    assert jobs(client) == before
