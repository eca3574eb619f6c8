"""The records that agent and base share: what each holds, under which key, and its code in bytes.

In: dataclasses of numpy arrays. Out: a key and a code for each, and back. A new kind is a module and a line here.
"""

from kiteline_codec.coding.packing import WireError as WireError
from kiteline_codec.schema.agent.camera_intrinsics import CameraIntrinsics as CameraIntrinsics
from kiteline_codec.schema.agent.gravity_alignment import GravityAlignment as GravityAlignment
from kiteline_codec.schema.agent.inertial_steps import InertialSteps as InertialSteps
from kiteline_codec.schema.agent.keyframe_header import KeyframeHeader as KeyframeHeader
from kiteline_codec.schema.agent.keyframe_scan import KeyframeScan as KeyframeScan
from kiteline_codec.schema.agent.live_pose import LivePose as LivePose
from kiteline_codec.schema.agent.new_landmarks import NewLandmarks as NewLandmarks
from kiteline_codec.schema.agent.observations import Observations as Observations
from kiteline_codec.schema.agent.scan_images import ScanImages as ScanImages
from kiteline_codec.schema.agent.stereo_alignment import StereoAlignment as StereoAlignment
from kiteline_codec.schema.agent.submap_scale import SubmapScale as SubmapScale
from kiteline_codec.schema.agent.submap_tie import SubmapTie as SubmapTie
from kiteline_codec.schema.base.cached_keyframe import CachedKeyframe as CachedKeyframe
from kiteline_codec.schema.base.cached_landmarks import CachedLandmarks as CachedLandmarks
from kiteline_codec.schema.base.correction_batch import CorrectionBatch as CorrectionBatch
from kiteline_codec.schema.base.culled_landmarks import CulledLandmarks as CulledLandmarks
from kiteline_codec.schema.base.disparity_calibration import DisparityCalibration as DisparityCalibration
from kiteline_codec.schema.base.fused_landmarks import FusedLandmarks as FusedLandmarks
from kiteline_codec.schema.base.grid_tile import GridTile as GridTile
from kiteline_codec.schema.base.keyframe_pose import KeyframePose as KeyframePose
from kiteline_codec.schema.base.refined_landmarks import RefinedLandmarks as RefinedLandmarks
from kiteline_codec.schema.base.removed_observations import RemovedObservations as RemovedObservations
from kiteline_codec.schema.base.submap_placement import SubmapPlacement as SubmapPlacement
from kiteline_codec.schema.record import RECORD_TYPES as RECORD_TYPES
from kiteline_codec.schema.record import IdOf as IdOf
from kiteline_codec.schema.record import Key as Key
from kiteline_codec.schema.record import Priority as Priority
from kiteline_codec.schema.record import Record as Record
from kiteline_codec.schema.record import kinds_keyed_by

KEYFRAME_KINDS = kinds_keyed_by(IdOf.KEYFRAME)
SUBMAP_KINDS = kinds_keyed_by(IdOf.SUBMAP)
CACHED_KINDS = kinds_keyed_by(IdOf.CACHED_KEYFRAME)
PASSING_KINDS = kinds_keyed_by(IdOf.PASSING_KEYFRAME)
AGENT_KINDS = frozenset(kind for kind, record in RECORD_TYPES.items() if record.written_by_agent())
PREDICTOR_KINDS = frozenset(kind for kind, record in RECORD_TYPES.items() if record.PREDICTS)
