"""Add-on of Blender that stylizes the Gaussian splat of the active object on a service of sgsst.

A splat is a mesh without faces whose vertices have the properties of a 3DGS PLY as attributes, as Blender's importer of
PLY files makes it with `Vertex Attributes`; or, from Blender 5.3 on, a point cloud with attributes of its own: scales
are standard deviations, and opacities are 0 to 1.
"""
# No postponed annotations: Blender reads the properties of its classes from them.

from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import bpy
import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from .sgsst_rest import COLORS, REQUIRED, BackgroundJob, Service, orbit_options, read_colors

#: Factor of the first spherical harmonic.
_SH_C0 = 0.28209479177387814
#: Attributes of a point cloud: colors and opacity, and each coefficient of the harmonics above degree 0.
_BASE, _REST = "radiance:base", "radiance:sh_"
#: Members of attributes that hold their values, by type; "vector" for others.
_MEMBERS = {"FLOAT": "value", "QUATERNION": "value", "FLOAT_COLOR": "color"}
#: Opacities whose logits are finite, and least standard deviation.
_OPACITIES, _LEAST = (1e-6, 1 - 1e-6), 1e-30
#: Name of the color attribute with the result.
_STYLIZED = "stylized"
_LOCAL = ("127.0.0.1", "::1", "localhost")


def _values(data: Any, name: str, width: int) -> Any:
    """Return an attribute of a mesh or point cloud, [N, width] float32."""
    attribute = data.attributes[name]
    values = np.empty(width * len(attribute.data), np.float32)
    attribute.data.foreach_get(_MEMBERS.get(attribute.data_type, "vector"), values)
    return values.reshape(-1, width)


def _set_values(data: Any, name: str, values: Any) -> None:
    attribute = data.attributes[name]
    member = _MEMBERS.get(attribute.data_type, "vector")
    attribute.data.foreach_set(member, np.ascontiguousarray(values, np.float32).ravel())


def splat_columns(data: Any) -> dict[str, Any]:
    """Return the splat of a mesh or point cloud as arrays by the property of a PLY.

    Raises:
        ValueError: If the data is no splat.
    """
    columns = dict(zip("xyz", _values(data, "position", 3).T, strict=True)) if "position" in data.attributes else {}
    if _BASE in data.attributes:
        base, scales = _values(data, _BASE, 4).astype(np.float64), _values(data, "scale", 3).astype(np.float64)
        opacities = np.clip(base[:, 3], *_OPACITIES)
        values = (*base[:, :3].T, np.log(opacities / (1 - opacities)), *np.log(np.maximum(scales, _LEAST)).T)
        columns |= dict(zip(REQUIRED, (*values, *_values(data, "rotation", 4).T), strict=True))
        count = sum(each.name.startswith(_REST) for each in data.attributes)
        for index in range(count):
            rest = _values(data, f"{_REST}{index}", 3)
            columns |= {f"f_rest_{channel * count + index}": rest[:, channel] for channel in range(3)}
        return columns
    missing = [name for name in REQUIRED if name not in data.attributes]
    if missing:
        raise ValueError(
            f"The active object has no attribute {missing[0]}, so it is no Gaussian splat. Import one by File > Import "
            "> Stanford PLY, with Vertex Attributes turned on."
        )
    names = [each.name for each in data.attributes if each.name in REQUIRED or each.name.startswith("f_rest_")]
    return columns | {name: _values(data, name, 1)[:, 0] for name in names}


def show_result(source: Any, path: Path, kind: str) -> Any:
    """Add a stylized PLY to the scene as a second object, or as a color attribute of its source; return the object.

    The second object is a copy, so it has the transform, materials and modifiers of its source.
    """
    colors = read_colors(path)
    if len(colors) != len(source.data.attributes["position"].data):  # Gaussians that cannot be drawn were dropped
        bpy.ops.wm.ply_import(filepath=str(path), import_attributes=True)
        target = bpy.context.object
        target.matrix_world = source.matrix_world
    elif kind == "ATTRIBUTE":
        target = source
    else:
        target = source.copy()
        target.data = source.data.copy()
        for collection in source.users_collection:
            collection.objects.link(target)
    mesh = target.data
    if target is not source:
        target.name = f"{source.name} stylized"
        if _BASE in mesh.attributes:
            _set_values(mesh, _BASE, np.column_stack([colors, _values(mesh, _BASE, 4)[:, 3]]))
        else:
            for index, name in enumerate(COLORS):
                _set_values(mesh, name, colors[:, index])
    shown = mesh.color_attributes.get(_STYLIZED) or mesh.color_attributes.new(_STYLIZED, "BYTE_COLOR", "POINT")
    rgba = np.ones((len(colors), 4), np.float32)
    rgba[:, :3] = np.clip(0.5 + _SH_C0 * colors, 0, 1)
    shown.data.foreach_set("color_srgb", rgba.ravel())
    if target.type == "MESH":
        mesh.color_attributes.active_color = shown
    mesh.update_tag()
    return target


class Current:
    """Job of this Blender, and the message of the last one."""

    job: BackgroundJob | None = None
    source_name = ""
    message = ""


def start(source: Any, settings: Any, service: Service) -> None:
    """Send an object's splat; raises like `splat_columns`, and ValueError without a style image."""
    options = orbit_options(settings.preset, settings.views, settings.up, settings.minutes)
    style = Path(bpy.path.abspath(settings.style))
    Current.job = BackgroundJob(service, splat_columns(source.data), style, **options)
    Current.source_name, Current.message = source.name, ""
    Current.job.start()
    bpy.app.timers.register(follow, first_interval=0.5, persistent=True)


def follow() -> float | None:
    """Show the progress or the result; return the seconds until the next call, None if the job has ended."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            area.tag_redraw()
    assert Current.job is not None
    if Current.job.is_alive():
        return 0.5
    job, Current.job = Current.job, None  # whatever follows, another job can be started
    source = bpy.data.objects.get(Current.source_name)
    if job.error or source is None:
        Current.message = job.error or f"The object {Current.source_name} is gone. Its result was not added."
    else:
        shown = show_result(source, job.out, bpy.context.scene.sgsst.result)
        Current.message = f"Painted {shown.name}."
    return None


class SgsstPreferences(bpy.types.AddonPreferences):
    """Address and key of the service."""

    bl_idname = __package__

    service: StringProperty(name="Service", default="http://127.0.0.1:8000")  # type: ignore[valid-type]
    key: StringProperty(name="API key", subtype="PASSWORD")  # type: ignore[valid-type]

    def draw(self, context: Any) -> None:  # noqa: ARG002 (Blender passes it)
        """Draw the preferences."""
        self.layout.prop(self, "service")
        self.layout.prop(self, "key")


class SgsstSettings(bpy.types.PropertyGroup):
    """Settings of the next job."""

    style: StringProperty(name="Style", subtype="FILE_PATH")  # type: ignore[valid-type]
    preset: EnumProperty(  # type: ignore[valid-type]
        name="Preset",
        items=[(name, name.capitalize(), "") for name in ("preview", "standard", "paper")],
        default="standard",
    )
    minutes: FloatProperty(  # type: ignore[valid-type]
        name="Minutes", description="Time budget; 0 for no limit", default=10, min=0, max=1440
    )
    views: IntProperty(  # type: ignore[valid-type]
        name="Views", description="Views around the splat; 0 for automatic", default=0, min=0, max=200
    )
    up: EnumProperty(  # type: ignore[valid-type]
        name="Up",
        description="Up axis of the splat before the object's rotation",
        items=[(name, name, "") for name in ("auto", "z", "-y", "y", "-z", "x", "-x")],
    )
    result: EnumProperty(  # type: ignore[valid-type]
        name="Result", items=[("OBJECT", "Second object", ""), ("ATTRIBUTE", "Color attribute", "")]
    )


class SgsstStylize(bpy.types.Operator):
    """Stylize the splat of the active object."""

    bl_idname = "sgsst.stylize"
    bl_label = "Stylize"

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Return whether a mesh or point cloud is active and no job runs."""
        return Current.job is None and context.object is not None and context.object.type in ("MESH", "POINTCLOUD")

    def execute(self, context: Any) -> set[str]:
        """Start the job, which runs in the background."""
        preferences = context.preferences.addons[__package__].preferences
        service = Service(preferences.service, preferences.key)
        try:
            if not bpy.app.online_access and urlsplit(service.url).hostname not in _LOCAL:
                raise ValueError("Allow Online Access in Preferences > System, or use a service on this machine.")
            start(context.object, context.scene.sgsst, service)
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class SgsstCancel(bpy.types.Operator):
    """Cancel the running job."""

    bl_idname = "sgsst.cancel"
    bl_label = "Cancel"

    def execute(self, context: Any) -> set[str]:  # noqa: ARG002 (Blender passes it)
        """Ask the job to end."""
        if Current.job is not None:
            Current.job.canceled.set()
        return {"FINISHED"}


class SgsstPanel(bpy.types.Panel):
    """Tab in the sidebar of the 3D view."""

    bl_idname = "VIEW3D_PT_sgsst"
    bl_label = "SGSST"
    bl_category = "SGSST"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"

    def draw(self, context: Any) -> None:
        """Draw settings, progress and message."""
        column = self.layout.column()
        for name in ("style", "preset", "minutes", "views", "up", "result"):
            column.prop(context.scene.sgsst, name)
        if Current.job is None:
            column.operator(SgsstStylize.bl_idname)
        else:
            column.progress(factor=Current.job.fraction, text=Current.job.text)
            column.operator(SgsstCancel.bl_idname)
        if Current.message:
            column.label(text=Current.message)


_CLASSES = (SgsstPreferences, SgsstSettings, SgsstStylize, SgsstCancel, SgsstPanel)


def register() -> None:
    """Register the classes."""
    for each in _CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.sgsst = PointerProperty(type=SgsstSettings)


def unregister() -> None:
    """Cancel a running job, and unregister the classes."""
    if Current.job is not None:
        Current.job.canceled.set()
        Current.job = None
        bpy.app.timers.unregister(follow)
    del bpy.types.Scene.sgsst
    for each in reversed(_CLASSES):
        bpy.utils.unregister_class(each)
