"""Makes a column scan of images that an agent sent, as a job: what the agent would do with them on board."""

from dataclasses import dataclass

from kiteline_basestation.jobs import JobKind
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.brightness import Brightness
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityStripes
from kiteline_core.ground.image_codes import decode_pair
from kiteline_core.ground.segmentation import ExpectedGround, GroundSegmenter, Segmented

_PIXEL_OPS = 110  # of matching, ground and labels, by pixel of a disparity image


@dataclass(frozen=True, slots=True)
class ScanInputs:
    """Images as coded, and what is known of them. offset_px: (5,) of the full image's disparities. uv: (n,2) pixels to
    label. expected: the height of the ground, where it is known. brightness: of the rig, by the images before.
    """

    images: bytes
    camera: RectifiedCamera
    config: GroundConfig
    up_c: F64
    offset_px: F64
    expected: ExpectedGround | None
    uv: F64
    brightness: Brightness


@dataclass(frozen=True, slots=True)
class ScanResult:
    """What the images show. labels: (n,) of the pixels."""

    seen: Segmented
    labels: U8
    brightness: Brightness


def _run(inputs: ScanInputs) -> ScanResult | None:
    """None where the bytes are no images of this camera."""
    segmenter = GroundSegmenter(inputs.camera, inputs.config)
    pair = decode_pair(inputs.images, segmenter.camera)
    if pair is None:
        return None
    stripes = DisparityStripes(segmenter.camera, inputs.config)
    stripes.brightness = inputs.brightness
    stripes.begin_reduced(pair)
    offset_px = inputs.offset_px * (segmenter.camera.bf / inputs.camera.bf)
    disparity = stripes.measure_begun()
    stripes.learn_brightness(disparity)
    seen = segmenter.segment(disparity, stripes.pair, inputs.up_c, offset_px, inputs.expected)
    return ScanResult(seen, segmenter.label_of(inputs.uv), stripes.brightness)


def _cost_ops(inputs: ScanInputs, result: ScanResult | None) -> int:
    return _PIXEL_OPS * (inputs.camera.width // 2) * (inputs.camera.height // 4)


SCAN = JobKind("scan", _run, _cost_ops, rank=3)
