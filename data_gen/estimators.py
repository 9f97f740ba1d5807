"""One work block of each quantity: irradiance at receivers, radiance SH at probes, radiance through pixels.

Every function traces ``REPLICATES`` independent replicates of ``samples`` paths per entity per round and returns
the replicates' means; rounds are averaged replicate by replicate.
"""

from __future__ import annotations

import numpy as np

from data_gen.components import Components
from data_gen.pathtracer import PathTracer, power_weight
from data_gen.rng import SampleStream
from data_gen.samplers import (
    cosine_hemisphere,
    cosine_hemisphere_pdf,
    dot,
    rotate_to,
    uniform_sphere,
    uniform_sphere_pdf,
)
from difflpv.scene import Camera
from difflpv.sh import sh_basis

__all__ = ["REPLICATES", "image_block", "irradiance_block", "probe_block"]

REPLICATES = 32


def _by_replicate(
    buckets: np.ndarray, components: Components, entities: int, samples: int, replicates: int = REPLICATES
) -> np.ndarray:
    """Means of each replicate's samples.

    Args:
        buckets: per path, shape [buckets, c, paths].
        components: what to sum the buckets to.
        entities: receivers, probes or pixels.
        samples: samples per replicate.
        replicates: of each entity.

    Returns:
        Shape [replicates, entities, components, c], float64.
    """
    count, channels, _ = buckets.shape
    means = buckets.reshape(count, channels, entities, replicates, samples).mean(-1, dtype=np.float64)
    total = np.zeros((len(components.names), *means.shape[1:]))
    for row, members in zip(total, components.membership, strict=True):
        for bucket in np.flatnonzero(members):
            row += means[bucket]
    return np.ascontiguousarray(total.transpose(3, 2, 0, 1))


def irradiance_block(
    tracer: PathTracer,
    positions: np.ndarray,
    normals: np.ndarray,
    components: Components,
    *,
    samples: int,
    seed: int,
    address: tuple[int, ...],
    round: int = 0,
    replicates: int = REPLICATES,
) -> np.ndarray:
    """Irradiance of a few receivers.

    Args:
        tracer: path tracer of the scene.
        positions: on the surface [n,3] m.
        normals: unit normals on the side asked for [n,3].
        components: which shares of the light.
        samples: paths per replicate and receiver,.
        seed: seed of the run.
        address: integers that name these entities.
        round: which part of each replicate's samples.
        replicates: independent estimates of each receiver.

    Returns:
        Irradiance [W/m2], shape [replicates, n, components, 3].
    """
    n = len(positions)
    stream = SampleStream(seed, *address, groups=n * replicates, samples=samples, round=round)
    per_receiver = replicates * samples
    points = np.repeat(np.asarray(positions.T, np.float32), per_receiver, 1)
    axes = np.repeat(np.asarray(normals.T, np.float32), per_receiver, 1)
    directions = rotate_to(cosine_hemisphere(stream.uniform(0, 2)), axes)
    pdf = cosine_hemisphere_pdf(dot(directions, axes))
    origins = tracer.lifted(points, axes)
    buckets = tracer.radiance(origins, directions, pdf, stream, components.bucket_of_bounce, dimension=4)
    buckets *= np.float32(np.pi)  # cosine sampling: cos/pdf = pi
    delta = np.zeros((n, 3))
    direct = components.bucket_of_bounce[0]
    if direct >= 0:
        buckets[direct] += tracer.area_irradiance(points, axes, stream.uniform(2, 2))
        delta = tracer.delta_irradiance(np.asarray(positions.T, np.float64), np.asarray(normals.T, np.float64)).T
    means = _by_replicate(buckets, components, n, samples, replicates)
    if direct >= 0:
        means += delta[None, :, None, :] * components.membership[None, None, :, direct, None]
    return means


def probe_block(
    tracer: PathTracer,
    positions: np.ndarray,
    components: Components,
    *,
    samples: int,
    seed: int,
    address: tuple[int, ...],
    round: int = 0,
    replicates: int = REPLICATES,
) -> np.ndarray:
    """Incident radiance of a few free-space points as SH coefficients c_i = integral of L_in(w) Y_i(w) dw.

    w points from the probe toward the incoming light. Point-like lights have exact coefficients: E Y_i(w).

    Args:
        tracer: path tracer of the scene.
        positions: [n,3] m.
        components: which shares of the light; k = 0 is light that comes straight from a light.
        samples: paths per replicate and probe,.
        seed: seed of the run.
        address: integers that name these entities.
        round: which part of each replicate's samples.
        replicates: independent estimates of each probe.

    Returns:
        Coefficients [W/m2], shape [replicates, n, components, 9, 3].
    """
    n = len(positions)
    stream = SampleStream(seed, *address, groups=n * replicates, samples=samples, round=round)
    origins = np.repeat(np.asarray(positions.T, np.float32), replicates * samples, 1)
    directions = uniform_sphere(stream.uniform(0, 2))
    pdf = np.full(origins.shape[1], uniform_sphere_pdf(), np.float32)
    buckets = tracer.radiance(origins, directions, pdf, stream, components.bucket_of_bounce, dimension=4)
    buckets /= pdf
    basis = np.ascontiguousarray(sh_basis(directions.T, 2).T)
    direct = components.bucket_of_bounce[0]
    lit = np.zeros_like(buckets[0])
    light_basis = basis
    if direct >= 0 and tracer.emitters.has_area:
        light = tracer.emitters.sample_area(origins, stream.uniform(2, 2))
        seen = np.flatnonzero(light.radiance.max(0) > 0)
        seen = seen[tracer.visible(origins[:, seen], light.direction[:, seen], light.distance[seen])]
        lit[:, seen] = light.radiance[:, seen] * (power_weight(light.pdf[seen], pdf[seen]) / light.pdf[seen])
        light_basis = np.ascontiguousarray(sh_basis(light.direction.T, 2).T)
    means = np.empty((replicates, n, len(components.names), 9, 3))
    for i in range(9):
        projected = buckets * basis[i]
        if direct >= 0:
            projected[direct] += lit * light_basis[i]
        means[:, :, :, i] = _by_replicate(projected, components, n, samples, replicates)
    if direct >= 0:
        exact = np.asarray(positions.T, np.float64)
        for index in range(len(tracer.emitters.deltas)):
            sample = tracer.emitters.delta(index, exact)
            free = tracer.visible(exact, sample.direction, sample.distance)
            sh = sh_basis(sample.direction.T, 2)[:, :, None] * (sample.irradiance * free).T[:, None]
            means += sh[None, :, None] * components.membership[None, None, :, direct, None, None]
    return means


def image_block(
    tracer: PathTracer,
    camera: Camera,
    pixels: np.ndarray,
    components: Components,
    *,
    samples: int,
    seed: int,
    address: tuple[int, ...],
    round: int = 0,
) -> np.ndarray:
    """Radiance through a few pixels, box filter.

    k counts the reflections before the visible surface, as for a receiver there: ``direct`` is what the surface
    reflects of the light that comes straight from a light. Visible emitters show their radiance in every component
    that contains k = 0.

    Args:
        tracer: path tracer of the scene.
        camera: the camera.
        pixels: row-major pixel indices [n].
        components: which shares of the light.
        samples: paths per replicate and pixel,.
        seed: seed of the run.
        address: integers that name these entities.
        round: which part of each replicate's samples.

    Returns:
        Radiance [W/(m2 sr)], shape [REPLICATES, n, components, 3].
    """
    n = len(pixels)
    stream = SampleStream(seed, *address, groups=n * REPLICATES, samples=samples, round=round)
    corner = np.stack([pixels % camera.width, pixels // camera.width], -1).repeat(REPLICATES * samples, 0)
    origins, directions = camera.rays(corner + stream.uniform(0, 2).T)
    # along a camera ray the visible surface is one more reflection, and emission counts as k = 0
    along_ray = np.concatenate([components.bucket_of_bounce[:1], components.bucket_of_bounce])
    buckets = tracer.radiance(
        np.ascontiguousarray(origins.T, np.float32),
        np.ascontiguousarray(directions.T, np.float32),
        np.inf,
        stream,
        along_ray,
        dimension=2,
    )
    return _by_replicate(buckets, components, n, samples)
