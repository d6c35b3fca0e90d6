"""Program that `test_blender.py` runs with Blender's Python module: it uses the add-on as a user would.

python in_blender.py ZIP SCENE STYLE URL
"""

import json
import sys
import time
from pathlib import Path

import bpy

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
bpy.ops.mesh.primitive_cube_add()
answer["cube"] = refusal()
bpy.context.view_layer.objects.active = source
bpy.context.scene.sgsst.style = style
bpy.ops.sgsst.stylize()
bpy.ops.preferences.addon_disable(module=module)  # while a job runs
answer["timer"] = bpy.app.timers.is_registered(addon.follow)
Path("answer.json").write_text(json.dumps(answer))
