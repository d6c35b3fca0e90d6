"""OpenAPI documentation of the body and errors of `POST /v1/jobs`, which FastAPI cannot derive from the route."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from api.http.documentation import invalid
from api.http.multipart import BadRequestError, MediaTypeError, TooSlowError
from api.http.schemas import SHA256
from service.errors import (
    BusyError,
    DamagedFileError,
    DamagedWeightsError,
    IdempotencyError,
    LockedError,
    LostFileError,
    NoSpaceError,
    NotFoundError,
    QueueFullError,
    QuotaError,
    RefusedInputError,
    ServiceError,
    StoreError,
    TooLargeError,
)
from service.files.staging import MOST_STYLES
from service.parameters import JobParameters
from sgsst_core.files.formats import TITLES


class JobFromUploads(BaseModel):
    """A job from files that are already uploaded (`POST /v1/uploads`)."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "scene": "upl_1a1fe701a104f943e9d4d8cce5b818c",
                    "style": "upl_1a1fe701b52a0c11d0ab9f6ad0c2a54",
                    "cameras": ["upl_1a1fe701b9e8e2a45b1c1d8c6bd8a90"],
                    "parameters": {"preset": "preview"},
                }
            ]
        },
    )

    scene: str = Field(description=f"Id of the upload with the 3DGS scene: {TITLES}.")
    style: str | Annotated[list[str], Field(min_length=1, max_length=MOST_STYLES)] = Field(
        description="Id of the upload with the style image; or a list of several, which are mixed by `style_weights`, "
        "or are those of `regions`."
    )
    cameras: list[str] = Field(default_factory=list, max_length=8, description="Camera files; empty for an orbit.")
    photos: list[str] = Field(default_factory=list, max_length=10_000, description="Photos for the content term.")
    parameters: JobParameters = Field(default_factory=JobParameters)
    webhook: str | None = Field(None, max_length=2000, description="URL to notify when the job ends.")


_FILE = {"type": "string", "format": "binary"}
_FORM = {
    "type": "object",
    "required": ["scene", "style"],
    "properties": {
        "scene": {**_FILE, "description": f"3DGS scene: {TITLES}; or the id of an upload."},
        "style": {
            "type": "array",
            "items": _FILE,
            "minItems": 1,
            "maxItems": MOST_STYLES,
            "description": "Style image; or the id of an upload. Several are mixed by `style_weights`; those that "
            "`regions` name are theirs.",
        },
        "cameras": {
            "type": "array",
            "items": _FILE,
            "description": "cameras.json, transforms.json, or the files of a COLMAP model.",
        },
        "photos": {"type": "array", "items": _FILE, "description": "Named as the cameras say."},
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

REFUSALS: tuple[ServiceError, ...] = (
    BadRequestError("The multipart body ends before its last boundary: it was cut off."),
    NotFoundError("The bytes of upload upl_1a1fe701a104f943e9d4d8cce5b818c are gone. Begin a new one."),
    TooSlowError("Nothing has come for 60 s, or less than 1000 bytes per second."),
    TooLargeError(
        "The request has 5,000,000,000 bytes. At most 4,000,000,000 are allowed. Use uploads.", limit=4_000_000_000
    ),
    MediaTypeError("The body must be multipart/form-data or application/json."),
    invalid("resolution", "Input should be greater than or equal to 1"),
    RefusedInputError(
        "scene.ply: holds no Gaussians (element vertex 0). Export the scene again.",
        "invalid-scene",
        input="scene",
    ),
    RefusedInputError(
        "style.jpg: is not an image that can be read. Give a PNG or JPEG.", "invalid-image", input="style"
    ),
    RefusedInputError("cameras.json: holds no cameras. Export them again.", "invalid-cameras", input="cameras"),
    RefusedInputError("The files cannot be read.", "invalid-input", input="scene"),
    RefusedInputError("Both numbers of steps are 0, so that nothing would change. Give some.", "invalid-settings"),
    RefusedInputError("The service has no weights of vgg19: its operator has to fetch them.", "invalid-weights"),
    RefusedInputError(
        "The scene has 30,000,000 Gaussians. At most 20,000,000 are allowed.",
        "too-many-gaussians",
        input="scene",
        limit=20_000_000,
    ),
    RefusedInputError("There are 3,000 views. At most 2,000 are allowed.", "too-many-views", input="cameras"),
    RefusedInputError(
        "All views have 30,000,000,000 pixels. At most 20,000,000,000 are allowed.", "too-many-pixels", input="cameras"
    ),
    RefusedInputError(
        "style.jpg: has 20000 x 20000 pixels. At most 100,000,000 are allowed.", "image-too-large", input="style"
    ),
    RefusedInputError("There are more than 2041 files.", "too-many-files"),
    RefusedInputError(
        "view 'view_0' (5187x3361): its 9,000,000 visible Gaussians touch raster tiles 3,000,000,000 times, more than "
        "can be addressed. Render at a lower resolution.",
        "too-many-intersections",
    ),
    RefusedInputError(
        "Reading the files takes more time or memory than allowed, or breaks their reader.", "inspection-limit"
    ),
    RefusedInputError(
        "'upl_1a1fe701a104f943e9d4d8cce5b818c' is not the ID of a usable upload, and 'scene' has no file name. Send an "
        "upload's ID, or a file with its name.",
        "unknown-upload",
        input="scene",
    ),
    RefusedInputError(
        "Upload upl_1a1fe701a104f943e9d4d8cce5b818c has 16,384 of 42,301 bytes. Finish it first.",
        "unfinished-upload",
        input="scene",
    ),
    RefusedInputError("Webhooks are switched off on this service.", "webhooks-off", input="webhook"),
    RefusedInputError(
        "'ftp://example.com' cannot be called: its scheme is neither http nor https. Give a URL such as "
        "'https://example.com/hook'.",
        "invalid-webhook",
        input="webhook",
    ),
    IdempotencyError("This Idempotency-Key was used for another request. Give each request its own key."),
    QueueFullError("There are 100 unfinished jobs of this key already. Wait for one to end, or cancel one.", limit=100),
    QuotaError(
        "This key may submit 1,000 jobs a day, and has. Come back tomorrow (UTC).",
        quota="jobs-a-day",
        limit=1000,
        retry_after=30_000,
    ),
    BusyError("Too many files are being checked. Try again later.", retry_after=10),
    NoSpaceError("The service's disk is too full to take this in. Try again later."),
    StoreError("The service's store of files does not answer. Try again later.", retry_after=10),
    DamagedWeightsError(),
    LockedError(),
    LostFileError.of(SHA256),
    DamagedFileError.of(SHA256),
)
