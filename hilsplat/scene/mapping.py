"""Structure from motion from verified matches: COLMAP's mappers with fixed seeds.

They use one thread, because the results of bundle adjustment depend on the number of threads.
"""

from copy import copy
from pathlib import Path

from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.features import LARGE_CAPTURE, MIN_INLIERS, incremental_options
from hilsplat.scene.layouts import MIN_PHOTOS

INIT_MIN_INLIERS = 50  # minimum number of matches in a model's first pair (COLMAP: 100)
POSE_MIN_INLIERS = 15  # minimum number of visible points needed to pose each additional view (COLMAP: 30)

STARTS = 5
START_VIEWS = 20
MIN_START_VIEWS = 10
"""A large capture's model continues the best of 5 models of 20 views, each from another first pair: the one
with the lowest reprojection error. Of fewer than 10 views, this error is no guide."""

GROWTH = 1.4
"""In a large capture, all poses are refined whenever a model has grown by this factor (COLMAP: 1.1)."""

GLOBAL_TOLERANCE = 1e-4
"""In a large capture, refinement stops when a step reduces the error by less than this share (COLMAP: 0)."""

NEW_PLACE = 1.5
"""A view that multiplies its visible points by more than this, when triangulated, shows a new place."""


def map_views(
    database: Path, images: Path, folder: Path, mapper: str, seed: int
) -> list[pycolmap.Reconstruction]:
    """Return the mapper's models of at least `MIN_PHOTOS` views, largest first.

    Despite `min_model_size`, COLMAP may return a model of two views; such models are dropped.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with pycolmap.Database.open(database) as opened:
        is_large = opened.num_images() > LARGE_CAPTURE
    options = incremental_options(seed)
    options.min_model_size = MIN_PHOTOS
    options.mapper.init_min_num_inliers = INIT_MIN_INLIERS
    options.mapper.abs_pose_min_num_inliers = POSE_MIN_INLIERS
    if mapper == "global":
        models = pycolmap.global_mapping(database, images, folder, _global_options(seed))
    elif is_large:
        models = dict(enumerate(_map_large_capture(database, images, options)))
    else:
        models = pycolmap.incremental_mapping(database, images, folder, options)
    large_enough = [model for _, model in sorted(models.items()) if model.num_reg_images() >= MIN_PHOTOS]
    return sorted(large_enough, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _map_large_capture(
    database: Path, images: Path, options: pycolmap.IncrementalPipelineOptions
) -> list[pycolmap.Reconstruction]:
    """Run COLMAP's incremental mapper with several starts and the refinements of `_grow`."""
    options.ba_global_function_tolerance = GLOBAL_TOLERANCE
    options.extract_colors = False
    with pycolmap.Database.open(database) as opened:
        loaded = pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches)
        cache = pycolmap.DatabaseCache.create(opened, loaded)
    pipeline = pycolmap.IncrementalPipeline(options, cache, pycolmap.ReconstructionManager())
    mapper, limits = pycolmap.IncrementalMapper(cache), options.get_mapper()
    models: list[pycolmap.Reconstruction] = []
    for _ in range(3):  # as COLMAP does, relax the requirements for the first pair twice
        mapper.reset_initialization_stats()
        while mapper.num_total_reg_images() < cache.num_images() - 1:
            model = _best_start(mapper, pipeline, limits)
            if model is None:
                break
            mapper.begin_reconstruction(model)
            _grow(model, mapper, options, cache.num_images())
            mapper.end_reconstruction(discard=False)
            model.extract_colors_for_all_images(images)
            models.append(model)
        limits.init_min_num_inliers //= 2
        limits.init_min_tri_angle /= 2
    return models


def _best_start(
    mapper: pycolmap.IncrementalMapper,
    pipeline: pycolmap.IncrementalPipeline,
    limits: pycolmap.IncrementalMapperOptions,
) -> pycolmap.Reconstruction | None:
    """Return the best of several models of `START_VIEWS` views, or None if all are too small."""
    starts: list[pycolmap.Reconstruction] = []
    status = pycolmap.IncrementalPipelineStatus.CONTINUE
    for _ in range(pipeline.options.init_num_trials):
        if len(starts) == STARTS or status == pycolmap.IncrementalPipelineStatus.NO_INITIAL_PAIR:
            break
        model = pycolmap.Reconstruction()
        mapper.begin_reconstruction(model)
        status = pipeline.initialize_reconstruction(mapper, limits, model)
        if status == pycolmap.IncrementalPipelineStatus.SUCCESS:
            _grow(model, mapper, pipeline.options, START_VIEWS)
            if model.num_reg_images() >= MIN_START_VIEWS:
                starts.append(copy(model))  # discarding a model removes its views
        mapper.end_reconstruction(discard=True)
    return min(starts, key=pycolmap.Reconstruction.compute_mean_reprojection_error, default=None)


def _grow(
    model: pycolmap.Reconstruction,
    mapper: pycolmap.IncrementalMapper,
    options: pycolmap.IncrementalPipelineOptions,
    max_views: int,
) -> None:
    """Register views with a model until it has `max_views` or no other can be registered, and refine it.

    As in COLMAP, each view is followed by a local refinement, but after `LARGE_CAPTURE` views only if it
    shows a new place. All poses are refined at growth by `GROWTH`; for more than 50 views, by an iterative
    solver instead of a sparse direct one, which takes six times as long for 900 views. Outliers are removed
    first, because views without a local refinement still have them.
    """
    limits, tracks = options.get_mapper(), options.get_triangulation()
    local, everywhere = options.get_local_bundle_adjustment(), options.get_global_bundle_adjustment()
    ceres = everywhere.ceres
    ceres.max_num_images_direct_sparse_cpu_solver = ceres.max_num_images_direct_dense_cpu_solver + 1
    num_refined = model.num_reg_images()
    while True:
        is_small = model.num_reg_images() <= LARGE_CAPTURE
        if not is_small:
            limits.abs_pose_max_error = limits.filter_max_reproj_error
        view = None
        if model.num_reg_images() < max_views and mapper.num_shared_reg_images() < options.max_model_overlap:
            view = _register_next(mapper, limits)
        if view is not None:
            num_visible = model.images[view].num_points3D
            mapper.triangulate_image(tracks, view)
            if is_small or model.images[view].num_points3D > NEW_PLACE * num_visible:
                passes, change = options.ba_local_max_refinements, options.ba_local_max_refinement_change
                mapper.iterative_local_refinement(passes, change, limits, local, tracks, view)
            if model.num_reg_images() < GROWTH * num_refined:
                continue
        passes, change = options.ba_global_max_refinements, options.ba_global_max_refinement_change
        mapper.filter_points(limits)
        mapper.iterative_global_refinement(passes if is_small else 1, change, limits, everywhere, tracks)
        mapper.filter_frames(limits)
        if view is None and model.num_reg_images() == num_refined:
            return
        num_refined = model.num_reg_images()


def _register_next(
    mapper: pycolmap.IncrementalMapper, limits: pycolmap.IncrementalMapperOptions
) -> int | None:
    """Register the best view that sees enough points, or else matches posed views; return it, or None."""
    for view in mapper.find_next_images(limits, structure_less=False):
        if mapper.register_next_image(limits, view):
            return view
    for view in mapper.find_next_images(limits, structure_less=True):
        if mapper.register_next_structure_less_image(limits, view):
            return view
    return None


def _global_options(seed: int) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=seed)
    options.min_num_matches, options.min_model_size = MIN_INLIERS, MIN_PHOTOS
    mapper = options.mapper
    mapper.num_threads = 1
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    mapper.random_seed = mapper.rotation_averaging.random_seed = seed
    mapper.global_positioning.random_seed = mapper.retriangulation.random_seed = seed
    mapper.global_positioning.use_gpu = False
    mapper.bundle_adjustment.ceres.use_gpu = False
    return options
