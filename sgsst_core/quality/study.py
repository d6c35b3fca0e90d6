"""Blind comparison of stylized scenes: a web page that collects votes, and the counting of these votes.

The page shows the style and, at one view after another, the renders of all variants in random order. It contains
neither names nor files of the variants, only random tokens; a key file beside it maps tokens to variants.
"""

import base64
import io
import random
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import scipy  # imports its modules at first use
from jinja2 import Environment, PackageLoader, StrictUndefined
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from sgsst_core.errors import InvalidInputError, SettingsError
from sgsst_core.files.atomic import atomic_path, write_json
from sgsst_core.files.images import to_image
from sgsst_core.settings import reason

#: Number of variants that a page can compare: one for each arrow key.
VARIANTS = range(2, 5)
#: Maximum longer side in pixels of the style image on the page.
_STYLE_SIDE = 640
_JPEG_QUALITY = 92


F = TypeVar("F", bound="_File")


class StudyError(InvalidInputError):
    """A key file or a file of votes that cannot be used."""


class _File(BaseModel):
    """Fields that all files of a study share."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    version: int = Field(1, ge=1, le=1)
    study: str


class Key(_File):
    """Key of a study: what its tokens stand for.

    Attributes:
        variants: Names of the variants, in the order in which they were given.
        views: Token of each variant's image, by view, in the order of `variants`.
    """

    variants: list[str]
    views: list[list[str]]


class Vote(BaseModel):
    """One choice."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    view: int = Field(ge=0)
    chosen: str


class Votes(_File):
    """Votes of one person, as the page saves them.

    Attributes:
        study: Name of the study that the votes belong to.
        voter: Random name of the session in which the votes were made.
        votes: At most one vote per view.
    """

    voter: str
    votes: list[Vote]


@dataclass(frozen=True)
class VoteShare:
    """Fraction of the votes that one variant received.

    Attributes:
        low: Lower end of the 95 % Wilson interval of the fraction.
    """

    variant: str
    votes: int
    total: int
    low: float
    high: float


def check_names(names: Sequence[str]) -> None:
    """Check the names of a study's variants.

    Raises:
        SettingsError: If there are not 2 to 4, or two are equal.
    """
    if len(names) not in VARIANTS:
        raise SettingsError(f"Number of scenes: {len(names)}. A study compares {VARIANTS[0]} to {VARIANTS[-1]}.")
    if len(set(names)) < len(names):
        raise SettingsError("Two scenes have the same name. Name them as NAME=FILE.")


def write_study(
    page: Path,
    key: Path,
    names: Sequence[str],
    style: Tensor,
    views: int,
    render: Callable[[int], Sequence[Tensor]],
) -> None:
    """Write the page of a study and its key.

    Args:
        style: Style image [H, W, 3] in 0..1.
        render: Function that returns the images [H, W, 3] of a variant at all views, by the variant's index.

    Raises:
        SettingsError: If the number of variants is not 2 to 4, or two have the same name.
        OutputError: If a file cannot be written.
    """
    check_names(names)
    tokens = [[secrets.token_hex(8) for _ in names] for _ in range(views)]
    images = {}
    for index in range(len(names)):
        for of_view, image in zip(tokens, render(index), strict=True):
            images[of_view[index]] = _data_uri(image)
    shuffled = [random.SystemRandom().sample(of_view, len(of_view)) for of_view in tokens]
    study = secrets.token_hex(8)
    data = {"study": study, "views": [[{"token": each, "image": images[each]} for each in view] for view in shuffled]}
    environment = Environment(
        loader=PackageLoader("sgsst_core.quality"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    text = environment.get_template("study.html").render(
        style=_data_uri(style, _STYLE_SIDE), data=data, count=len(names)
    )
    with atomic_path(page) as temporary:
        temporary.write_text(text, encoding="utf-8")
        write_json(key, Key(study=study, variants=list(names), views=tokens).model_dump())  # no page without its key


def count_votes(key: Path, files: Sequence[Path]) -> list[VoteShare]:
    """Return the fraction of votes of each variant, in descending order.

    A file that was saved twice counts once: the longer one of the same voter.

    Raises:
        StudyError: If a file cannot be read, belongs to another study, or there are no votes.
    """
    known = _read(Key, key)
    if any(len(tokens) != len(known.variants) for tokens in known.views):
        raise StudyError(f"{key}: not the key of a study: a view lacks the token of a variant. Use an intact copy.")
    variant_of = [dict(zip(tokens, known.variants, strict=True)) for tokens in known.views]
    by_voter: dict[str, Votes] = {}
    for path in files:
        result = _read(Votes, path)
        if result.study != known.study:
            raise StudyError(f"{path}: holds votes of another study than {key}.")
        views = [vote.view for vote in result.votes]
        if len(set(views)) < len(views) or any(
            vote.view >= len(variant_of) or vote.chosen not in variant_of[vote.view] for vote in result.votes
        ):
            raise StudyError(f"{path}: holds votes that the study's page does not make. Save them again.")
        before = by_voter.get(result.voter)
        if before is None or len(before.votes) < len(result.votes):
            by_voter[result.voter] = result
    chosen = [variant_of[vote.view][vote.chosen] for votes in by_voter.values() for vote in votes.votes]
    if not chosen:
        raise StudyError("There are no votes in these files.")
    shares = []
    for name in known.variants:
        interval = scipy.stats.binomtest(chosen.count(name), len(chosen)).proportion_ci(0.95, method="wilson")
        shares.append(VoteShare(name, chosen.count(name), len(chosen), float(interval.low), float(interval.high)))
    return sorted(shares, key=lambda share: -share.votes)


def _read(kind: type[F], path: Path) -> F:
    try:
        return kind.model_validate_json(path.read_bytes())
    except OSError as error:
        raise StudyError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        what = "the key of a study" if kind is Key else "a file of votes"
        raise StudyError(f"{path}: not {what}: {where}: {reason(first)}.") from error


def _data_uri(image: Tensor, most: int = 1 << 16) -> str:
    """Return an image [H, W, 3] in 0..1 as a data URI with a JPEG, with at most `most` pixels per side."""
    buffer, jpeg = io.BytesIO(), to_image(image)
    jpeg.thumbnail((most, most))
    jpeg.save(buffer, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
