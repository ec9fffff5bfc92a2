"""Groups that the user defines: folders of images, or lists of views."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    GradientProbe,
    Grouping,
    GroupingRule,
    Scene,
    UserError,
    View,
    read_rows,
)
from crossgrad_plugins.groupings.split import require_training_views


class Lists(Grouping):
    """Labels from the images' top folder, or from a file of the user.

    Without a file, the label of `aerial/0001.jpg` is `aerial`. A file is CSV with two columns, view
    name and label. A name that ends with a slash is a folder, and its label applies to all views in
    it.
    """

    labels: ClassVar[tuple[str, ...]] = ()

    file: Path | None = Field(
        None, description="CSV file: view name (or folder with a slash at the end), label"
    )

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        require_training_views(scene, "lists")
        table = None if self.file is None else read_labels(self.file)

        def labels(views: Sequence[View]) -> tuple[str, ...]:
            if self.file is None or table is None:
                return tuple(_folder(view.name) for view in views)
            return tuple(_listed(view.name, table, self.file) for view in views)

        train = set(labels(scene.train_views))
        _require_two(train, self.file)
        return GroupingRule(labels, (f"grouping lists: {', '.join(sorted(train))}",))


def read_labels(path: Path) -> dict[str, str]:
    """Return the mapping of view name or folder (ending with a slash) to label.

    Raises:
        UserError: The file is missing, a row does not have two columns, or a name has two labels.
    """
    todo = "check the path; the file must be UTF-8 text with rows `name,label`"
    rows = [row for row in read_rows(path, "the list of labels", todo) if row]
    table: dict[str, str] = {}
    for row in rows:
        if row[0].startswith("#"):
            continue
        cells = [cell.strip() for cell in row]
        if len(cells) != 2 or not all(cells):  # noqa: PLR2004 - a name and a label
            raise UserError(
                "a row in the list of labels does not consist of a name and a label",
                where=path,
                expected="image.jpg,near",
                found=",".join(row),
                todo="write two columns: the name of a view (or of a folder, ending with a slash) "
                "and its label",
            )
        name, label = cells
        if table.setdefault(name, label) != label:
            raise UserError(
                "a view has two labels in the list",
                where=path,
                found=f"{name}: {table[name]}, {label}",
                todo="remove one of the two rows",
            )
    return table


def _folder(name: str) -> str:
    """Return the top folder of a view's name, or an empty text if there is none."""
    return name.split("/", 1)[0] if "/" in name else ""


def _listed(name: str, table: Mapping[str, str], path: Path) -> str:
    """Return the label of the view, or of the innermost listed folder that contains it."""
    if name in table:
        return table[name]
    parts = name.split("/")
    for depth in range(len(parts) - 1, 0, -1):
        folder = "/".join(parts[:depth]) + "/"
        if folder in table:
            return table[folder]
    raise UserError(
        "a view has no label in the list",
        where=path,
        expected="a row for every view, or for a folder that contains it",
        found=name,
        todo=f"add the row `{name},LABEL`",
    )


def _require_two(train: set[str], path: Path | None) -> None:
    if len(train) > 1:
        return
    if path is None:
        raise UserError(
            "grouping lists found training views in only one folder",
            where="grouping",
            expected="photos in at least two folders below the image folder, or a file of labels",
            todo="name a CSV file (view name, label): --set grouping.file=labels.csv",
        )
    raise UserError(
        "all training views have the same label in the list",
        where=path,
        expected="at least two different labels",
        found=", ".join(sorted(train)),
        todo="give some training views another label, or choose another grouping",
    )
