#include "repeats.h"

#include <array>
#include <cmath>

#include <google/protobuf/util/message_differencer.h>

namespace mapless {
namespace {

// Metres, degrees, parts of a direction or quaternion: errors of rounding where the server normalizes.
constexpr double kSame = 1e-9;

bool Near(double a, double b) { return std::abs(a - b) <= kSame; }

bool SameRotation(const v1::Quaternion& a, const v1::Quaternion& b) {
  const double both = a.x() * b.x() + a.y() * b.y() + a.z() * b.z() + a.w() * b.w();
  const auto length = [](const v1::Quaternion& q) { return std::sqrt(q.x() * q.x() + q.y() * q.y() + q.z() * q.z() + q.w() * q.w()); };
  // q and -q turn alike; of unit quaternions, the cosine of half the angle between them.
  return length(a) > 0 && length(b) > 0 && std::abs(both) / (length(a) * length(b)) > 1 - kSame * kSame - 1e-15;
}

bool SameDirection(const v1::Vector3& a, const v1::Vector3& b) {
  const double la = std::hypot(a.x(), a.y(), a.z()), lb = std::hypot(b.x(), b.y(), b.z());
  return la > 0 && lb > 0 && Near(a.x() / la, b.x() / lb) && Near(a.y() / la, b.y() / lb) && Near(a.z() / la, b.z() / lb);
}

v1::Quaternion RotationOf(const v1::Datum& datum) {
  if (datum.has_enu_from_world()) return datum.enu_from_world();
  v1::Quaternion identity;
  identity.set_w(1);
  return identity;
}

bool SameDatum(const v1::Datum& a, const v1::Datum& b) {
  return Near(a.latitude_deg(), b.latitude_deg()) && Near(a.longitude_deg(), b.longitude_deg()) &&
         Near(a.height_m(), b.height_m()) && SameRotation(RotationOf(a), RotationOf(b));
}

// Values, unit, sensor and confidence; a camera of its own comes back with the same numbers, its pose normalized.
bool SameDepth(const v1::DepthImage& a, const v1::DepthImage& b) {
  return a.png() == b.png() && a.float32() == b.float32() && a.unit_m() == b.unit_m() && a.sensor() == b.sensor() &&
         a.confidence() == b.confidence() && a.has_intrinsics() == b.has_intrinsics() &&
         google::protobuf::util::MessageDifferencer::Equals(a.intrinsics(), b.intrinsics());
}

}  // namespace

bool IsSame(const v1::CreateSceneRequest& wanted, const v1::Scene& stored) {
  return stored.generation() == 1 && stored.arbitrary_unit() == wanted.arbitrary_unit() &&
         stored.has_datum() == wanted.has_datum() && stored.has_down_in_world() == wanted.has_down_in_world() &&
         (!wanted.has_datum() || SameDatum(wanted.datum(), stored.datum())) &&
         (!wanted.has_down_in_world() || SameDirection(wanted.down_in_world(), stored.down_in_world()));
}

bool IsSame(const v1::Reference& wanted, const v1::Reference& stored) {
  const auto &a = wanted.world_from_camera(), &b = stored.world_from_camera();
  return wanted.image() == stored.image() && wanted.has_mask() == stored.has_mask() && wanted.mask() == stored.mask() &&
         wanted.has_depth() == stored.has_depth() && SameDepth(wanted.depth(), stored.depth()) &&
         google::protobuf::util::MessageDifferencer::Equals(wanted.intrinsics(), stored.intrinsics()) &&
         SameRotation(a.rotation(), b.rotation()) && Near(a.translation_m().x(), b.translation_m().x()) &&
         Near(a.translation_m().y(), b.translation_m().y()) && Near(a.translation_m().z(), b.translation_m().z());
}

}  // namespace mapless
