"""Program that `test_blender.py` runs with Blender's Python module: it uses the add-on as a user would.

python in_blender.py ZIP SCENE STYLE URL
"""

import json
import sys
import time
from pathlib import Path

import bpy
import numpy as np

package, scene, style, url = sys.argv[1:]


def stylize(source, **settings):
    """Run a job with these settings, as clicks and Blender's event loop do, and return message and progress."""
    bpy.context.view_layer.objects.active = source
    for name, value in {"style": style, "preset": "preview", "views": 4, "up": "-y", **settings}.items():
        setattr(bpy.context.scene.sgsst, name, value)
    assert bpy.ops.sgsst.stylize() == {"FINISHED"}
    assert not bpy.ops.sgsst.stylize.poll(), "a second job can be started"
    texts = []
    while addon.Current.job is not None:
        texts.append(addon.Current.job.text)
        if settings.get("minutes") == 1440:
            bpy.ops.sgsst.cancel()
        time.sleep(0.1)
        if addon.follow() is None:  # without a window, Blender calls no timers
            bpy.app.timers.unregister(addon.follow)
    return addon.Current.message, texts


def refusal(**settings):
    """Return why a job was refused."""
    try:
        return stylize(bpy.context.object, **settings)[0]
    except RuntimeError as error:
        return str(error)


def values(target, name):
    """Return a float attribute of an object."""
    return [each.value for each in target.data.attributes[name].data]


bpy.ops.preferences.addon_enable(module="bl_pkg")
bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True)
module = "bl_ext.user_default.sgsst"
addon = sys.modules[module]
preferences = bpy.context.preferences.addons[module].preferences

bpy.ops.wm.ply_import(filepath=scene, import_attributes=True)
source = bpy.context.object
source.location = (1, 2, 3)
before = values(source, "f_dc_0")
answer = {}
preferences.service = "http://127.0.0.1:9"
answer["unreachable"] = refusal()
preferences.service = "https://example.com"
bpy.context.preferences.system.use_online_access = False
answer["offline"] = refusal()
preferences.service = url
answer["no style"] = refusal(style="missing.png")
answer["canceled"] = stylize(source, minutes=1440)[0]
answer["object"], answer["progress"] = stylize(source, minutes=0.5)
target = bpy.data.objects[f"{source.name} stylized"]
answer["moved"] = list(target.location)
answer["f_dc_0"] = values(target, "f_dc_0")
answer["unchanged"] = values(source, "f_dc_0") == before
count = len(bpy.data.objects)
answer["attribute"] = stylize(source, minutes=0.5, result="ATTRIBUTE")[0]
answer["added objects"] = len(bpy.data.objects) - count
answer["colors"] = [list(each.color_srgb) for each in source.data.color_attributes["stylized"].data]


def point_cloud(columns):
    """Return an object with a splat as Blender 5.3 imports it: a point cloud with activated values."""
    mesh = bpy.data.meshes.new("points")
    mesh.from_pydata(np.stack([columns[name] for name in "xyz"], axis=1).tolist(), [], [])
    points = bpy.data.objects.new("points", mesh)
    bpy.context.collection.objects.link(points)
    bpy.ops.object.select_all(action="DESELECT")
    bpy.context.view_layer.objects.active = points
    points.select_set(True)
    bpy.ops.object.convert(target="POINTCLOUD")
    four = "FLOAT4" if bpy.app.version >= (5, 3, 0) else "FLOAT_COLOR"
    several = {
        "scale": ("FLOAT_VECTOR", "vector", [np.exp(columns[f"scale_{i}"]) for i in range(3)]),
        "rotation": ("QUATERNION", "value", [columns[f"rot_{i}"] for i in range(4)]),
        "radiance:base": (
            four,
            "vector" if four == "FLOAT4" else "color",
            [*(columns[f"f_dc_{i}"] for i in range(3)), 1 / (1 + np.exp(-columns["opacity"]))],
        ),
    }
    for k in range(3):
        several[f"radiance:sh_{k}"] = ("FLOAT_VECTOR", "vector", [columns[f"f_rest_{3 * c + k}"] for c in range(3)])
    for name, (kind, member, values) in several.items():
        attribute = bpy.context.object.data.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(member, np.stack(values, axis=1).astype(np.float32).ravel())
    return bpy.context.object


expected = addon.splat_columns(source.data)
points = point_cloud(expected)
read = addon.splat_columns(points.data)
answer["points"] = read.keys() == expected.keys() and all(
    np.allclose(read[name], expected[name], rtol=1e-4, atol=1e-4) for name in read
)
answer["points can be stylized"] = bpy.ops.sgsst.stylize.poll()
red = {**read, "f_dc_0": read["f_dc_0"] + 1}
addon.write_splat(Path("red.ply"), red)
shown = addon.splat_columns(addon.show_result(points, Path("red.ply"), "OBJECT").data)
answer["points shown"] = all(np.allclose(shown[name], red[name], rtol=1e-4, atol=1e-4) for name in red)
bpy.ops.mesh.primitive_cube_add()
answer["cube"] = refusal()
bpy.context.view_layer.objects.active = source
bpy.context.scene.sgsst.style = style
bpy.ops.sgsst.stylize()
bpy.ops.preferences.addon_disable(module=module)  # while a job runs
answer["timer"] = bpy.app.timers.is_registered(addon.follow)
Path("answer.json").write_text(json.dumps(answer))
