"""What is known of references, as messages."""

from __future__ import annotations

from mapless import names, wire
from mapless.v1 import reference_service_pb2 as pb
from mapless_server.scenes.audit.coverage import Coverage
from mapless_server.scenes.audit.verdict import ReferenceAudit
from mapless_server.scenes.retrieval.chosen import Choice
from mapless_server.store import ReferenceRecord

from .enums import enum_to_message


def reference_to_message(reference: ReferenceRecord) -> pb.Reference:
    """Message of a reference, without its image."""
    message = pb.Reference(
        name=names.reference_name(reference.scene_id, reference.reference_id),
        intrinsics=wire.camera_to_message(reference.camera),
        world_from_camera=wire.transform_to_message(reference.world_from_camera),
        image_sha256=reference.image_sha256,
        feature_count=reference.feature_count,
    )
    message.create_time.FromDatetime(reference.create_time)
    return message


def choice_to_message(choice: Choice, scene_id: str) -> pb.RetrieveReferencesResponse:
    """Message of references that were chosen."""
    message = pb.RetrieveReferencesResponse(descriptor=choice.descriptor, store_generation=choice.generation)
    for chosen in choice.references:
        message.references.add(
            name=names.reference_name(scene_id, chosen.reference_id),
            similarity=chosen.similarity,
            world_from_camera=wire.transform_to_message(chosen.world_from_camera),
        )
    return message


def audit_to_message(audit: ReferenceAudit) -> pb.ReferenceAudit:
    """Message of an audit; what is not known is 0."""
    return pb.ReferenceAudit(
        name=audit.reference,
        verdict=enum_to_message(audit.verdict, pb.AuditVerdict),
        message=audit.message,
        neighbour_count=audit.neighbour_count,
        match_count=audit.match_count,
        inlier_count=audit.inlier_count,
        reprojection_error_px=audit.error_px or 0.0,
        position_offset_m=audit.position_offset_m or 0.0,
        rotation_offset_deg=audit.rotation_offset_deg or 0.0,
        focal_ratio=audit.focal_ratio or 0.0,
        other=audit.other,
    )


def coverage_to_message(coverage: Coverage) -> pb.CheckCoverageResponse:
    """Message of a forecast, without the generation."""
    return pb.CheckCoverageResponse(
        verdict=enum_to_message(coverage.verdict, pb.CoverageVerdict),
        message=coverage.message,
        expected_match_count=coverage.expected_match_count,
        image_share=coverage.image_share,
        position_68_m=coverage.position_68_m or 0.0,
        references=coverage.references,
    )
