"""OpenAPI documentation of the body of `POST /v1/jobs`, which FastAPI cannot derive from the route."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from service.examples import UPLOAD_ID
from service.files.staging import MOST_STYLES
from service.parameters import JobParameters
from sgsst_core.files.formats import TITLES


class JobFromUploads(BaseModel):
    """A job from files that the service already has, or that it fetches.

    Each file is named by the id of its upload (`POST /v1/uploads`), by the path of an input of an earlier job, such as
    `/v1/jobs/JOB/inputs/style:1`, or by a URL that the service fetches, if its operator allows the host.
    """

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "scene": UPLOAD_ID,
                    "style": "upl_1a1fe701b52a0c11d0ab9f6ad0c2a54",
                    "cameras": ["upl_1a1fe701b9e8e2a45b1c1d8c6bd8a90"],
                    "parameters": {"preset": "preview"},
                }
            ]
        },
    )

    scene: str = Field(
        description=f"Id of the upload with the 3DGS scene: {TITLES}; or the path of an input, or a URL."
    )
    style: str | Annotated[list[str], Field(min_length=1, max_length=MOST_STYLES)] = Field(
        description="Id of the upload with the style image, the path of an input, or a URL; or a list of several, "
        "which are mixed by `style_weights`, or belong to `regions`."
    )
    cameras: list[str] = Field(default_factory=list, max_length=8, description="Camera files; empty for an orbit.")
    photos: list[str] = Field(default_factory=list, max_length=10_000, description="Photos for the content term.")
    mask: list[str] = Field(default_factory=list, max_length=10_000, description="Masks that `regions` name.")
    parameters: JobParameters = Field(default_factory=JobParameters)
    webhook: str | None = Field(None, max_length=2000, description="URL to notify when the job ends.")


_FILE = {"type": "string", "format": "binary"}
_FORM = {
    "type": "object",
    "required": ["scene", "style"],
    "properties": {
        "scene": {**_FILE, "description": f"3DGS scene: {TITLES}; or text, as for JSON."},
        "style": {
            "type": "array",
            "items": _FILE,
            "minItems": 1,
            "maxItems": MOST_STYLES,
            "description": "Style image; or text, as for JSON. Several are mixed by `style_weights`; those that "
            "`regions` name belong to the regions.",
        },
        "cameras": {
            "type": "array",
            "items": _FILE,
            "description": "cameras.json, transforms.json, or the files of a COLMAP model.",
        },
        "photos": {"type": "array", "items": _FILE, "description": "Photos with the names that the cameras give."},
        "mask": {
            "type": "array",
            "items": _FILE,
            "description": "Mask that a region in `regions` names: one bit per Gaussian (.bin), or .npy; or images of "
            "views in a folder.",
        },
        "parameters": {"type": "string", "description": "JSON: see JobParameters."},
        "webhook": {"type": "string", "description": "URL to notify when the job ends."},
    },
    "examples": [
        {
            "scene": "ply\nformat binary_little_endian 1.0\nelement vertex 616\n(and so on: the file's bytes)",
            "style": ["(the bytes of style.jpg)"],
            "cameras": ['[{"id": 0, "img_name": "view_0", "width": 64, "height": 48}]'],
            "parameters": '{"preset": "preview"}',
        }
    ],
}
BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {"schema": _FORM},
            "application/json": {"schema": {"$ref": "#/components/schemas/JobFromUploads"}},
        },
    }
}
