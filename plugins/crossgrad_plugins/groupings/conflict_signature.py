"""Groups of cameras whose gradients agree."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree
from typing_extensions import override

from crossgrad_core.plugin import (
    GradientProbe,
    GroupingRule,
    Model,
    Regrouping,
    Scene,
    UserError,
    View,
    centers_of,
    radial_distances,
)
from crossgrad_plugins.groupings.distance import Radial
from crossgrad_plugins.groupings.split import (
    FAR,
    NEAR,
    require_groups,
    require_training_views,
    smaller_mean_first,
)

#: Differences between eigenvalues of a cosine matrix below this value count as rounding errors.
_SMALLEST_GAP = 1e-9


class ConflictSignature(Regrouping):
    """Two groups of cameras, from a spectral cut of the cosines between their gradients.

    The cosine of two gradients is computed per parameter block and averaged over the blocks. The
    similarity of two cameras is (1 + cosine) / 2. The group with the smaller mean radial distance
    is near. A view without a measured gradient gets the label of the nearest camera with a measured
    gradient. Before step `at`, the views are grouped as by `radial`, because no gradients are
    available.

    Source: the paper, which names this grouping without a definition; the definition was made for
    crossgrad.
    """

    needs_probe: ClassVar[bool] = True

    at: int = Field(
        500, ge=1, description="step after which the views are grouped by their gradients"
    )
    cameras: int = Field(
        96, ge=2, description="maximum number of probed views, evenly spaced by name"
    )

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        require_training_views(scene, "conflict-signature")
        if probe is None:
            early = Radial().fit(scene, rng)
            later = f"grouping conflict-signature: by gradients after step {self.at}, before that:"
            return GroupingRule(early.labels, (later, *early.notes))
        count = min(self.cameras, len(scene.train))
        probed = np.unique(np.linspace(0, len(scene.train) - 1, count).round().astype(int))
        cosines = mean_cosines(probe.gramians([int(i) for i in probed]))
        sides = spectral_cut(cosines)
        chosen = [scene.train_views[i] for i in probed]
        near = smaller_mean_first(sides, radial_distances(scene, chosen))
        train = [NEAR if side == near else FAR for side in sides]
        require_groups("conflict-signature", train, (NEAR, FAR), "gradient directions")
        tree = cKDTree(centers_of(chosen))

        def labels(views: Sequence[View]) -> tuple[str, ...]:
            _, nearest = tree.query(centers_of(views))
            return tuple(train[i] for i in nearest)

        note = (
            f"grouping conflict-signature: {train.count(NEAR)} of {len(train)} probed "
            "views are near"
        )
        return GroupingRule(labels, (note,))

    @property
    @override
    def refit_after(self) -> int:
        return self.at

    @override
    def refit(self, model: Model, rng: np.random.Generator) -> GroupingRule:
        from crossgrad_plugins.diagnostics.probe import ModelProbe

        try:
            return self.fit(model.scene, rng, ModelProbe(model, rng))
        except UserError as error:
            # If all gradients agree, the run keeps its present groups.
            early = Radial().fit(model.scene, rng)
            return GroupingRule(early.labels, (f"the groups do not change: {error.what}",))


def mean_cosines(gramians: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [V, V] cosines, averaged over the blocks of the Gramians [B, V, V].

    If a gradient of a pair is zero in a block, the pair has no cosine in this block. A pair without
    a cosine in any block gets cosine 0.
    """
    norms = np.sqrt(np.einsum("bii->bi", gramians))
    products = norms[:, :, None] * norms[:, None, :]
    valid = products > 0.0
    cosines = np.divide(gramians, products, out=np.zeros_like(gramians), where=valid)
    return np.asarray(np.clip(cosines, -1.0, 1.0).sum(axis=0) / np.maximum(valid.sum(axis=0), 1))


def spectral_cut(cosines: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return [V] side 0 or 1: the sign of the normalised Laplacian's second eigenvector.

    All cameras are on side 0 if there is no second eigenvector, for example with one camera or
    identical cameras.

    Source: Shi and Malik 2000, with similarity (1 + cosine) / 2.
    """
    similarity = (1.0 + cosines) / 2.0
    root = np.sqrt(similarity.sum(axis=1))
    # The second smallest eigenvalue of I - S is one minus the second largest eigenvalue of S. The
    # largest eigenvalue of S is 1, and its eigenvector is known. If two groups have no similarity,
    # S has the eigenvalue 1 twice. The known eigenvector is therefore removed from S before the
    # other eigenvector is computed.
    scaled = similarity / root[:, None] / root[None, :]
    first = root / np.linalg.norm(root)
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2.0 - 2.0 * np.outer(first, first))
    # After the removal, the known eigenvector has eigenvalue -1, and no other eigenvalue is
    # smaller. For two identical cameras, the other eigenvalue is 0.
    if len(values) == 1 or min(values[-1], values[-1] - values[-2]) <= _SMALLEST_GAP:
        return np.zeros(len(values), dtype=np.int64)
    return (vectors[:, -1] > 0.0).astype(np.int64)
