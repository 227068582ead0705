"""Maps that others wrote, from packages that may be missing."""

import pickle
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from time import perf_counter
from warnings import catch_warnings, simplefilter

import numpy as np

from clients.contenders import Contender, fill, has_both, set_aside
from clients.protocol import Bools, Floats, LabelledPoints, hit_ends, labelled_points
from gpom_core.baselines import CountingGrid
from gpom_core.metrics import negative_log_likelihood
from gpom_core.scan import Scan

GP_POINTS = 300
HILBERT_POINTS = 10_000
HILBERT_FEATURES = 500
HILBERT_LENGTHS_M = (0.5, 1.0)
SPARSE_POINTS = 20_000
SPARSE_INDUCING = 512
SPARSE_STEPS = 400
_SPARSE_BATCH = 1024
_SPARSE_RATE = 0.02
_SPARSE_LENGTH_M = 0.5  # to begin with
_SPARSE_JITTER = 1e-4  # inducing points come close to each other
_HIT_WEIGHT, _PRIOR_COUNT = 20.0, 0.2
GRIDS_M = (0.05, 0.07, 0.1, 0.15, 0.2)
_SEED = 3
_BATCH = 4096

Builder = Callable[[Sequence[Scan], float], Contender]
"""From training scans and the cell size that suits a log-odds grid to a map."""


def octomap_map(training: Sequence[Scan], resolution_m: float) -> Contender:
    """OctoMap itself in its default settings: one layer of cells of an octree."""
    import octomap

    tree = octomap.OcTree(resolution_m)
    height_m = resolution_m / 2
    started = perf_counter()
    for scan in training:
        ends = hit_ends(scan)
        cloud = np.column_stack([ends, np.full(len(ends), height_m)])
        tree.insertPointCloud(cloud, np.array([*scan.pose[:2], height_m]), -1.0, True)
    tree.updateInnerOccupancy()

    def predict(points: Floats) -> tuple[Floats, Bools]:
        occupancy, known = np.full(len(points), 0.5), np.zeros(len(points), np.bool_)
        for i, (x, y) in enumerate(points):
            try:
                occupancy[i] = tree.search(np.array([x, y, height_m])).getOccupancy()
                known[i] = True
            except octomap.NullPointerException:  # no such node: never seen
                continue
        return occupancy, known

    facts = {
        "resolution_m": resolution_m,
        "build_s": round(perf_counter() - started, 4),
        "memory_bytes": tree.memoryUsage(),
    }
    return Contender("OctoMap", predict, facts)


def calibrated_grids(training: Sequence[Scan], _resolution_m: float) -> Contender:
    """Counting grids of five sizes, and a logistic regression on hits, misses and log odds of each.

    The regression is scikit-learn's, on every fifth training scan and grids of the others; so it is
    calibrated much as the map is, and tells what a process adds to counting. Unknown stays at 0.5.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    started = perf_counter()
    rest, aside = set_aside(training)
    model = make_pipeline(
        StandardScaler(with_mean=False),
        LogisticRegression(C=0.25, fit_intercept=False, max_iter=1000),
    )
    fitted = has_both(aside)
    if fitted:
        model.fit(_counted(_counting(rest), aside.points), aside.occupied)
    grids = _counting(training)

    def predict(points: Floats) -> tuple[Floats, Bools]:
        counts = _counted(grids, points)
        known = np.asarray(counts.any(axis=1), np.bool_)
        occupancy = model.predict_proba(counts)[:, 1] if fitted else np.full(len(points), 0.5)
        return occupancy, known

    facts = {
        "build_s": round(perf_counter() - started, 4),
        "memory_bytes": sum(grid.size_bytes for grid in grids),
    }
    return Contender("calibrated grids", predict, facts)


def _counting(scans: Sequence[Scan]) -> list[CountingGrid]:
    grids = [CountingGrid(edge_m) for edge_m in GRIDS_M]
    for grid in grids:
        fill(grid, scans)
    return grids


def _counted(grids: Sequence[CountingGrid], points: Floats) -> Floats:
    columns = []
    for grid in grids:
        hits, misses = grid.counts(points)
        odds = (_HIT_WEIGHT * hits + _PRIOR_COUNT) / (misses + _PRIOR_COUNT)
        columns += [np.log1p(hits), np.log1p(misses), np.log(odds)]
    return np.column_stack(columns)


def gp_classifier(training: Sequence[Scan], _resolution_m: float) -> Contender:
    """scikit-learn's exact GP classifier (Laplace) on as many points as it can take.

    Its kernel and length scale are learned by marginal likelihood. It is cubic in the points, so
    on a building it stands for what one small exact process can know, not for GP maps at large.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessClassifier
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    points = labelled_points(training, _SEED, GP_POINTS)
    kernel = ConstantKernel(4.0, (0.1, 1e5)) * RBF(0.5, (0.1, 5.0))
    started = perf_counter()
    model = GaussianProcessClassifier(kernel, random_state=_SEED)
    with catch_warnings():
        simplefilter("ignore", ConvergenceWarning)  # a bound that is reached is an answer, too
        model.fit(points.points, points.occupied)
    facts = {
        "points_used": len(points),
        "build_s": round(perf_counter() - started, 4),
        "memory_bytes": len(pickle.dumps(model)),
    }
    return Contender("GP classifier", _asking(model), facts)


def sparse_gp(training: Sequence[Scan], _resolution_m: float) -> Contender:
    """GPyTorch's sparse variational GP classifier (Hensman et al. 2015), all of it learned.

    One process for the whole building, its inducing points free to move, by Adam on random batches
    of points drawn as for the other classifiers.
    """
    import gpytorch
    import torch

    class Process(gpytorch.models.ApproximateGP):  # type: ignore[misc]
        def __init__(self, inducing: torch.Tensor) -> None:
            weights = gpytorch.variational.CholeskyVariationalDistribution(len(inducing))
            super().__init__(gpytorch.variational.VariationalStrategy(self, inducing, weights))
            self.mean = gpytorch.means.ConstantMean()
            self.kernel = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel())
            self.kernel.base_kernel.lengthscale = _SPARSE_LENGTH_M

        def forward(self, x: torch.Tensor) -> object:
            return gpytorch.distributions.MultivariateNormal(self.mean(x), self.kernel(x))

    points = labelled_points(training, _SEED, SPARSE_POINTS)
    torch.manual_seed(_SEED)
    torch.set_num_threads(1)  # as everybody here
    started = perf_counter()
    x = torch.as_tensor(points.points, dtype=torch.float32)
    y = torch.as_tensor(points.occupied, dtype=torch.float32)
    process = Process(x[torch.randperm(len(x))[:SPARSE_INDUCING]].clone())
    likelihood = gpytorch.likelihoods.BernoulliLikelihood()
    bound = gpytorch.mlls.VariationalELBO(likelihood, process, num_data=len(x))
    steps = torch.optim.Adam(process.parameters(), lr=_SPARSE_RATE)
    jitter = gpytorch.settings.cholesky_jitter(_SPARSE_JITTER, _SPARSE_JITTER)
    with jitter:
        for _ in range(SPARSE_STEPS):
            some = torch.randint(len(x), (_SPARSE_BATCH,))
            steps.zero_grad()
            loss = -bound(process(x[some]), y[some])
            loss.backward()
            steps.step()
    process.eval()
    facts = {
        "points_used": len(points),
        "inducing_points": SPARSE_INDUCING,
        "length_scale_m": round(process.kernel.base_kernel.lengthscale.item(), 3),
        "build_s": round(perf_counter() - started, 4),
        "memory_bytes": sum(p.numel() * p.element_size() for p in process.parameters()),
    }

    def predict(asked: Floats) -> tuple[Floats, Bools]:
        with torch.no_grad(), jitter:
            parts = [
                likelihood(process(torch.as_tensor(part, dtype=torch.float32))).mean.numpy()
                for part in np.array_split(asked, -(-len(asked) // _BATCH))
            ]
        return np.concatenate(parts).astype(np.float64), np.ones(len(asked), np.bool_)

    return Contender("sparse GP", predict, facts)


def hilbert_map(training: Sequence[Scan], _resolution_m: float) -> Contender:
    """A map as Ramos & Ott's Hilbert maps (2016): logistic regression on kernel features, by SGD.

    scikit-learn's Nystroem features and SGDClassifier; the length scale is the best of two on
    every fifth training scan.
    """
    started = perf_counter()
    rest, aside = set_aside(training)
    length_m = HILBERT_LENGTHS_M[0]
    if has_both(aside):
        aside = aside.where(np.arange(min(len(aside), 5000)) * len(aside) // min(len(aside), 5000))
        some = labelled_points(rest, _SEED, HILBERT_POINTS // 2)
        length_m = min(
            HILBERT_LENGTHS_M,
            key=lambda length: negative_log_likelihood(
                _asking(_hilbert(some, length))(aside.points)[0], aside.occupied
            ),
        )
    model = _hilbert(labelled_points(training, _SEED, HILBERT_POINTS), length_m)
    facts = {
        "length_scale_m": length_m,
        "features": HILBERT_FEATURES,
        "build_s": round(perf_counter() - started, 4),
        "memory_bytes": len(pickle.dumps(model)),
    }
    return Contender("Hilbert map", _asking(model), facts)


def _hilbert(points: LabelledPoints, length_m: float) -> object:
    from sklearn.kernel_approximation import Nystroem
    from sklearn.linear_model import SGDClassifier
    from sklearn.pipeline import make_pipeline

    features = Nystroem(
        gamma=0.5 / length_m**2,
        n_components=min(HILBERT_FEATURES, len(points)),
        random_state=_SEED,
    )
    regression = SGDClassifier(loss="log_loss", alpha=1e-6, random_state=_SEED, average=True)
    model = make_pipeline(features, regression)
    model.fit(points.points, points.occupied)
    return model


def _asking(model: object) -> Callable[[Floats], tuple[Floats, Bools]]:
    def predict(points: Floats) -> tuple[Floats, Bools]:
        parts = [
            model.predict_proba(points[i : i + _BATCH])[:, 1]  # type: ignore[attr-defined]
            for i in range(0, len(points), _BATCH)
        ]
        return np.concatenate(parts), np.ones(len(points), np.bool_)

    return predict


PEERS: dict[str, tuple[str, str, Builder]] = {
    "calibrated grids": ("sklearn", "scikit-learn", calibrated_grids),
    "OctoMap": ("octomap", "octomap-python", octomap_map),
    "GP classifier": ("sklearn", "scikit-learn", gp_classifier),
    "Hilbert map": ("sklearn", "scikit-learn", hilbert_map),
    "sparse GP": ("gpytorch", "gpytorch", sparse_gp),
}
"""Name to the module it needs, the package that brings it, and how it is built."""


def missing_peers() -> dict[str, str]:
    """Peers that cannot take part, and the package that each needs."""
    return {
        name: package for name, (module, package, _) in PEERS.items() if find_spec(module) is None
    }


def peers(training: Sequence[Scan], resolution_m: float) -> list[Contender]:
    """Build every peer whose package is there.

    Args:
        resolution_m: of the cells that suit a log-odds grid.
    """
    absent = missing_peers()
    return [
        build(training, resolution_m) for name, (_, _, build) in PEERS.items() if name not in absent
    ]
