"""Conversion of video frames to 8-bit sRGB, using the stream's matrix and range, and tone-mapping HDR."""

import functools

import numpy as np
from av import VideoFrame
from av.video.reformatter import Interpolation
from jaxtyping import Float32, Float64, UInt8, UInt16

from hilsplat.base.images import srgb_codes

PQ, HLG = 16, 18  # transfer characteristics of HDR video (ITU-T H.273): SMPTE ST 2084 and ARIB STD-B67
UNSPECIFIED, BT709, BT601 = 2, 1, 5  # colour matrices (ITU-T H.273)
WHITE_NITS = 203.0  # luminance of reference white in HDR video (ITU-R BT.2408)

HLG_PEAK_NITS, HLG_SYSTEM_GAMMA = 1000.0, 1.2  # reference display for HLG (ITU-R BT.2100)
KNEE = 0.6  # linear light (white = 1) above which HDR highlights are compressed towards 1
BAND_ROWS = 32  # number of rows tone-mapped at once, chosen to fit into the processor's cache

BT709_FROM_BT2020: Float64[np.ndarray, "3 3"] = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]]
)
"""Matrix from linear BT.2020 to linear BT.709 RGB (inverse of ITU-R BT.2087)."""

EXACT = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
EXACT |= Interpolation.BITEXACT

BT2020_LUMA = np.array([0.2627, 0.6780, 0.0593], dtype=np.float32)


def rgb_pixels(frame: VideoFrame, width: int | None = None) -> UInt8[np.ndarray, "H W 3"]:
    """Convert a decoded frame to 8-bit sRGB, scaled to a width (px) if given, without rotating it.

    If a stream states no matrix, video players' default is used: BT.709 for 720 lines or more, else BT.601.
    HDR (PQ or HLG) is converted to linear light with BT.709 primaries and compressed highlights.
    """
    matrix = int(frame.colorspace)
    if matrix == UNSPECIFIED:
        matrix = BT709 if min(frame.width, frame.height) >= 720 else BT601
    is_hdr = int(frame.color_trc) in (PQ, HLG)
    form = "rgb48le" if is_hdr else "rgb24"
    rgb = frame.reformat(width, format=form, src_colorspace=matrix, interpolation=EXACT, threads=1)
    pixels = rgb.to_ndarray()
    if not is_hdr:
        return pixels
    is_hlg = int(frame.color_trc) == HLG
    bands = [pixels[row : row + BAND_ROWS] for row in range(0, len(pixels), BAND_ROWS)]
    return np.concatenate([srgb_from_hdr(band, is_hlg=is_hlg) for band in bands])


def srgb_from_hdr(signal: UInt16[np.ndarray, "H W 3"], *, is_hlg: bool) -> UInt8[np.ndarray, "H W 3"]:
    """Tone-map an HDR picture (full-range 16-bit RGB, BT.2020 primaries) to 8-bit sRGB.

    Values up to 0.6 of white are unchanged. Higher values are compressed: white becomes 0.8, and brighter
    values stay below 1. All channels are scaled by the strongest channel's factor, which preserves the hue.
    """
    light = _hlg_light()[signal] if is_hlg else _pq_light()[signal]
    if is_hlg:  # the display's gamma applies to luminance (BT.2100, OOTF)
        luminance = light @ BT2020_LUMA
        light *= (HLG_PEAK_NITS / WHITE_NITS * luminance ** (HLG_SYSTEM_GAMMA - 1))[..., None]
    light = np.maximum(light @ BT709_FROM_BT2020.T.astype(np.float32), 0)
    peak = light.max(axis=2)
    above = np.maximum(peak - KNEE, 0) / (1 - KNEE)
    mapped = np.minimum(peak, KNEE) + (1 - KNEE) * above / (1 + above)
    light *= (mapped / np.maximum(peak, 1e-6))[..., None]
    return _srgb_codes()[(light * 65535 + 0.5).astype(np.uint16)]


@functools.cache
def _pq_light() -> Float32[np.ndarray, "65536"]:
    """Return the lookup table from PQ signal to linear light, white = 1 (SMPTE ST 2084)."""
    power = (np.arange(65536) / 65535) ** (1 / 78.84375)
    nits = 10000 * (np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)) ** (
        1 / 0.1593017578125
    )
    return (nits / WHITE_NITS).astype(np.float32)


@functools.cache
def _hlg_light() -> Float32[np.ndarray, "65536"]:
    """Return the lookup table from HLG signal to scene light in [0, 1] (ARIB STD-B67)."""
    signal = np.arange(65536) / 65535
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12).astype(np.float32)


@functools.cache
def _srgb_codes() -> UInt8[np.ndarray, "65536"]:
    """Return the lookup table from linear light (65536 steps) to 8-bit sRGB."""
    return srgb_codes(np.arange(65536) / 65535)
