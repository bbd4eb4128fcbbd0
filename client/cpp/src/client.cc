#include "mapless/client.h"

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <future>
#include <iterator>
#include <utility>

#include <grpcpp/generic/generic_stub.h>

#include "mapless/client/wire.pb.h"
#include "repeats.h"
#include "routing.h"
#include "servers.h"

namespace mapless {
namespace {

constexpr int kPageSize = 1'000;
constexpr char kHealth[] = "/grpc.health.v1.Health/Check";
constexpr int kServing = 1;
// Of a health check, which asks how the server is now.
constexpr int kCheckAttempts = 4;

[[noreturn]] void Throw(const grpc::Status& given, const grpc::ClientContext& context) {
  const grpc::Status status = StatusOf(given, context);
  const auto& trailers = context.GetServerTrailingMetadata();
  const auto found = trailers.find("x-request-id");
  const std::string id = found == trailers.end() ? "" : std::string(found->second.data(), found->second.size());
  switch (status.error_code()) {
    case grpc::StatusCode::INVALID_ARGUMENT: throw InvalidArgument(status, id);
    case grpc::StatusCode::UNAUTHENTICATED: throw Unauthenticated(status, id);
    case grpc::StatusCode::PERMISSION_DENIED: throw PermissionDenied(status, id);
    case grpc::StatusCode::NOT_FOUND: throw NotFound(status, id);
    case grpc::StatusCode::ALREADY_EXISTS: throw AlreadyExists(status, id);
    case grpc::StatusCode::FAILED_PRECONDITION: throw FailedPrecondition(status, id);
    case grpc::StatusCode::RESOURCE_EXHAUSTED: throw ResourceExhausted(status, id);
    case grpc::StatusCode::DEADLINE_EXCEEDED: throw DeadlineExceeded(status, id);
    case grpc::StatusCode::CANCELLED:  // by a server that stops; the client cancels no call that is waited for
    case grpc::StatusCode::UNAVAILABLE: throw Unavailable(status, id);
    case grpc::StatusCode::DATA_LOSS: throw DataLoss(status, id);
    case grpc::StatusCode::INTERNAL: throw Internal(status, id);
    default: throw Error(status, id);
  }
}

const char* NameOf(grpc::StatusCode code) {
  static constexpr const char* kNames[] = {"OK", "CANCELLED", "UNKNOWN", "INVALID_ARGUMENT", "DEADLINE_EXCEEDED", "NOT_FOUND",
                                           "ALREADY_EXISTS", "PERMISSION_DENIED", "RESOURCE_EXHAUSTED", "FAILED_PRECONDITION",
                                           "ABORTED", "OUT_OF_RANGE", "UNIMPLEMENTED", "INTERNAL", "UNAVAILABLE", "DATA_LOSS",
                                           "UNAUTHENTICATED"};
  return code >= 0 && static_cast<std::size_t>(code) < std::size(kNames) ? kNames[code] : "UNKNOWN";
}

// A detail of a status, unpacked; false if there is none of the type. Compared by the name that google.rpc has for it.
template <class Detail>
bool Unpack(const client::Status& status, const std::string& name, Detail* detail) {
  for (const auto& packed : status.details()) {
    const std::string& url = packed.type_url();
    if (url.substr(url.rfind('/') + 1) == "google.rpc." + name) return detail->ParseFromString(packed.value());
  }
  return false;
}

client::Status DetailsOf(const grpc::Status& status) {
  client::Status details;
  if (!details.ParseFromString(status.error_details())) details.Clear();  // a proxy's own form
  return details;
}

std::string Sentence(const grpc::Status& status) {
  client::ErrorInfo info;
  const bool has = Unpack(DetailsOf(status), "ErrorInfo", &info);
  return (has ? info.reason() : NameOf(status.error_code())) + ": " + status.error_message();
}

}  // namespace

Error::Error(const grpc::Status& status, const std::string& id)
    : std::runtime_error(Sentence(status)),
      code(status.error_code()),
      reason(NameOf(status.error_code())),
      message(status.error_message()),
      request_id(id) {
  const client::Status details = DetailsOf(status);
  if (client::ErrorInfo info; Unpack(details, "ErrorInfo", &info)) {
    reason = info.reason();
    if (const auto it = info.metadata().find("field"); it != info.metadata().end()) field = it->second;
  }
  if (client::ResourceInfo info; Unpack(details, "ResourceInfo", &info)) resource = info.resource_name();
  if (client::RequestInfo info; Unpack(details, "RequestInfo", &info)) request_id = info.request_id();
  if (client::RetryInfo info; Unpack(details, "RetryInfo", &info)) {
    retry_after = std::chrono::milliseconds(info.retry_delay().seconds() * 1'000 + info.retry_delay().nanos() / 1'000'000);
  }
}

Client::Client(ConnectOptions options) : options_(std::move(options)), servers_(std::make_unique<Servers>(options_)) {}
Client::~Client() = default;
Client::Client(Client&&) noexcept = default;

void Client::Prepare(grpc::ClientContext& context, const google::protobuf::Message& request,
                     std::chrono::system_clock::time_point deadline) const {
  context.set_deadline(deadline);
  if (!options_.token.empty()) context.AddMetadata("authorization", "Bearer " + options_.token);
  if (!options_.client_id.empty()) context.AddMetadata("x-client-id", options_.client_id);
  if (const std::string scene = SceneOf(request); !scene.empty()) context.AddMetadata("x-mapless-scene", scene);
}

template <class Stub, class Request, class Response>
Response Client::Unary(grpc::Status (Stub::*method)(grpc::ClientContext*, const Request&, Response*), const Request& request,
                       Timeout timeout, const std::function<bool(Response&, Timeout)>& find) const {
  Attempts attempts(options_, *servers_, timeout);
  while (true) {
    Server& server = servers_->Next();
    grpc::ClientContext context;
    Prepare(context, request, attempts.Deadline());
    Response response;
    Stub* stub = server.Of(static_cast<const Stub*>(nullptr));
    const grpc::Status status = (stub->*method)(&context, request, &response);
    if (status.ok()) {
      attempts.Answered(server);
      return response;
    }
    const auto code = status.error_code();
    const bool is_conflict = code == grpc::StatusCode::ALREADY_EXISTS || code == grpc::StatusCode::NOT_FOUND;
    if (is_conflict && find && attempts.MayBeDone() && find(response, attempts.Left())) return response;
    if (!attempts.Pause(server, status, context)) Throw(status, context);
  }
}

bool Client::IsServing(Timeout timeout) const {
  Attempts attempts(options_, *servers_, timeout, kCheckAttempts);
  while (true) {
    Server& server = servers_->Next();
    grpc::ClientContext context;
    client::HealthCheckRequest request;
    client::HealthCheckResponse response;
    Prepare(context, request, attempts.Deadline());
    grpc::TemplatedGenericStub<client::HealthCheckRequest, client::HealthCheckResponse> stub(server.channel);
    std::promise<grpc::Status> ended;
    stub.UnaryCall(&context, kHealth, grpc::StubOptions(), &request, &response,
                   [&ended](grpc::Status status) { ended.set_value(std::move(status)); });
    const grpc::Status status = ended.get_future().get();
    if (status.ok()) {
      attempts.Answered(server);
      return response.status() == kServing;
    }
    if (!attempts.Pause(server, status, context)) Throw(status, context);
  }
}

using Localizing = v1::LocalizationService::Stub;
using Referencing = v1::ReferenceService::Stub;

// What was to be deleted is gone, by an attempt whose answer was lost. (Nothing to be deleted exists already.)
template <class Response>
const std::function<bool(Response&, Client::Timeout)> kGone = [](Response&, Client::Timeout) { return true; };

v1::LocalizeResponse Client::Localize(const v1::LocalizeRequest& request, Timeout timeout) const {
  return Unary(&Localizing::Localize, request, timeout);
}

v1::LocalizeResponse Client::LocalizeProgressively(const v1::LocalizeRequest& request,
                                                   const std::function<void(const v1::LocalizeResponse&)>& on_better,
                                                   Timeout timeout) const {
  Attempts attempts(options_, *servers_, timeout);
  bool had_better = false, is_repeated = false;
  while (true) {
    Server& server = servers_->Next();
    grpc::ClientContext context;  // the call is cancelled where `on_better` throws
    Prepare(context, request, attempts.Deadline());
    const auto reader = server.localization->LocalizeProgressively(&context, request);
    v1::LocalizeProgressivelyResponse message;
    std::optional<v1::LocalizeResponse> answer;
    try {
      while (reader->Read(&message)) {
        attempts.Answered(server);
        if (message.is_final()) {
          answer = message.answer();
        } else if (on_better && !is_repeated) {
          had_better = true;
          on_better(message.answer());
        }
      }
    } catch (...) {
      context.TryCancel();
      reader->Finish();
      throw;
    }
    const grpc::Status status = reader->Finish();
    if (answer) return *answer;
    if (status.ok()) Throw({grpc::StatusCode::INTERNAL, "the stream ended before the answer"}, context);
    if (!attempts.Pause(server, status, context)) Throw(status, context);
    is_repeated = had_better;  // what comes earlier could be worse than what was given already
  }
}

v1::LocalizeRigResponse Client::LocalizeRig(const v1::LocalizeRigRequest& request, Timeout timeout) const {
  return Unary(&Localizing::LocalizeRig, request, timeout);
}

v1::LocalizeSequenceResponse Client::LocalizeSequence(const v1::LocalizeSequenceRequest& request, Timeout timeout) const {
  return Unary(&Localizing::LocalizeSequence, request, timeout);
}

v1::Scene Client::CreateScene(const v1::CreateSceneRequest& request, Timeout timeout) const {
  const std::function<bool(v1::CreateSceneResponse&, Timeout)> find = [&](v1::CreateSceneResponse& response, Timeout left) {
    try {
      *response.mutable_scene() = GetScene(request.scene_id(), left);
    } catch (const NotFound&) {
      return false;
    }
    return IsSame(request, response.scene());
  };
  return Unary(&Referencing::CreateScene, request, timeout, find).scene();
}

v1::Scene Client::GetScene(const std::string& scene, Timeout timeout) const {
  v1::GetSceneRequest request;
  request.set_name("scenes/" + scene);
  return Unary(&Referencing::GetScene, request, timeout).scene();
}

v1::UpdateSceneResponse Client::UpdateScene(const v1::UpdateSceneRequest& request, Timeout timeout) const {
  return Unary(&Referencing::UpdateScene, request, timeout);
}

std::vector<v1::Scene> Client::ListScenes(Timeout timeout) const {
  std::vector<v1::Scene> scenes;
  v1::ListScenesRequest request;
  request.set_page_size(kPageSize);
  do {
    const auto page = Unary(&Referencing::ListScenes, request, timeout);
    scenes.insert(scenes.end(), page.scenes().begin(), page.scenes().end());
    request.set_page_token(page.next_page_token());
  } while (!request.page_token().empty());
  return scenes;
}

void Client::DeleteScene(const std::string& scene, Timeout timeout) const {
  v1::DeleteSceneRequest request;
  request.set_name("scenes/" + scene);
  Unary(&Referencing::DeleteScene, request, timeout, kGone<v1::DeleteSceneResponse>);
}

bool Client::Stored(const std::string& scene, const v1::CreateReferenceRequest& wanted, v1::Reference& stored,
                    Timeout timeout) const {
  v1::GetReferenceRequest request;
  request.set_name(scene + "/references/" + wanted.reference_id());
  request.set_include_image(true);
  try {
    stored = Unary(&Referencing::GetReference, request, timeout).reference();
  } catch (const NotFound&) {
    return false;
  }
  const bool is_same = IsSame(wanted.reference(), stored);
  stored.clear_image();
  stored.clear_mask();
  stored.clear_depth();
  return is_same;
}

v1::CreateReferenceResponse Client::CreateReference(const v1::CreateReferenceRequest& request, Timeout timeout) const {
  const std::function<bool(v1::CreateReferenceResponse&, Timeout)> find =
      [&](v1::CreateReferenceResponse& response, Timeout left) {
        return Stored(request.scene(), request, *response.mutable_reference(), left);
      };
  return Unary(&Referencing::CreateReference, request, timeout == Timeout{} ? options_.upload_timeout : timeout, find);
}

std::vector<v1::Reference> Client::AddReferences(const std::string& scene,
                                                 const std::vector<v1::CreateReferenceRequest>& references,
                                                 const std::function<void(std::size_t)>& on_progress) const {
  std::vector<v1::Reference> stored;
  for (auto next = references.begin(); next != references.end();) {
    v1::BatchCreateReferencesRequest batch;
    batch.set_scene("scenes/" + scene);
    double bytes = 0;
    do {
      bytes += static_cast<double>(next->ByteSizeLong());
      *batch.add_requests() = *next++;
    } while (next != references.end() && batch.requests_size() < options_.batch_count &&
             bytes + static_cast<double>(next->ByteSizeLong()) <= options_.batch_mib * (1 << 20));
    const std::function<bool(v1::BatchCreateReferencesResponse&, Timeout)> find =
        [&](v1::BatchCreateReferencesResponse& response, Timeout left) {
          return std::all_of(batch.requests().begin(), batch.requests().end(), [&](const auto& it) {
            return Stored(batch.scene(), it, *response.add_references(), left);
          });
        };
    const auto done = Unary(&Referencing::BatchCreateReferences, batch, options_.upload_timeout, find);
    stored.insert(stored.end(), done.references().begin(), done.references().end());
    if (on_progress) on_progress(stored.size());
  }
  return stored;
}

v1::Reference Client::GetReference(const std::string& scene, const std::string& reference, bool include_image,
                                   Timeout timeout) const {
  v1::GetReferenceRequest request;
  request.set_name("scenes/" + scene + "/references/" + reference);
  request.set_include_image(include_image);
  return Unary(&Referencing::GetReference, request, timeout).reference();
}

std::vector<v1::Reference> Client::ListReferences(const std::string& scene, Timeout timeout) const {
  std::vector<v1::Reference> references;
  v1::ListReferencesRequest request;
  request.set_scene("scenes/" + scene);
  request.set_page_size(kPageSize);
  do {
    const auto page = Unary(&Referencing::ListReferences, request, timeout);
    references.insert(references.end(), page.references().begin(), page.references().end());
    request.set_page_token(page.next_page_token());
  } while (!request.page_token().empty());
  return references;
}

void Client::DeleteReference(const std::string& scene, const std::string& reference, Timeout timeout) const {
  v1::DeleteReferenceRequest request;
  request.set_name("scenes/" + scene + "/references/" + reference);
  Unary(&Referencing::DeleteReference, request, timeout, kGone<v1::DeleteReferenceResponse>);
}

v1::RetrieveReferencesResponse Client::RetrieveReferences(const v1::RetrieveReferencesRequest& request,
                                                          Timeout timeout) const {
  return Unary(&Referencing::RetrieveReferences, request, timeout);
}

v1::AuditSceneResponse Client::AuditScene(const v1::AuditSceneRequest& request, Timeout timeout) const {
  return Unary(&Referencing::AuditScene, request, timeout);
}

v1::CheckCoverageResponse Client::CheckCoverage(const v1::CheckCoverageRequest& request, Timeout timeout) const {
  return Unary(&Referencing::CheckCoverage, request, timeout);
}

v1::CameraIntrinsics Pinhole(int width_px, int height_px, double focal_x_px, double focal_y_px, double principal_x_px,
                             double principal_y_px) {
  v1::CameraIntrinsics camera;
  camera.set_width_px(width_px);
  camera.set_height_px(height_px);
  camera.set_focal_x_px(focal_x_px);
  camera.set_focal_y_px(focal_y_px);
  camera.set_principal_x_px(principal_x_px);
  camera.set_principal_y_px(principal_y_px);
  return camera;
}

v1::DepthImage DepthPng(std::string png, double unit_m, v1::DepthSensor sensor) {
  v1::DepthImage depth;
  depth.set_png(std::move(png));
  depth.set_unit_m(unit_m);
  depth.set_sensor(sensor);
  return depth;
}

v1::DepthImage DepthMetres(const std::vector<float>& metres, int width_px, int height_px, v1::DepthSensor sensor) {
  static_assert(sizeof(float) == 4, "the interface has floats of 4 bytes");
  if (width_px < 1 || height_px < 1 || metres.size() != static_cast<std::size_t>(width_px) * static_cast<std::size_t>(height_px))
    throw std::invalid_argument("a depth of " + std::to_string(width_px) + "x" + std::to_string(height_px) + " cannot have " +
                                std::to_string(metres.size()) + " values");
  std::string bytes;
  bytes.reserve(4 * metres.size());
  for (const float value : metres) {  // little-endian on any machine
    std::uint32_t bits = 0;
    std::memcpy(&bits, &value, sizeof bits);
    for (int shift = 0; shift < 32; shift += 8) bytes.push_back(static_cast<char>(bits >> shift & 0xff));
  }
  v1::DepthImage depth;
  depth.set_float32(std::move(bytes));
  depth.set_width_px(width_px);
  depth.set_height_px(height_px);
  depth.set_unit_m(1);
  depth.set_sensor(sensor);
  return depth;
}

v1::RigidTransform Pose(double qx, double qy, double qz, double qw, double x_m, double y_m, double z_m) {
  v1::RigidTransform pose;
  pose.mutable_rotation()->set_x(qx);
  pose.mutable_rotation()->set_y(qy);
  pose.mutable_rotation()->set_z(qz);
  pose.mutable_rotation()->set_w(qw);
  pose.mutable_translation_m()->set_x(x_m);
  pose.mutable_translation_m()->set_y(y_m);
  pose.mutable_translation_m()->set_z(z_m);
  return pose;
}

std::string ReadFile(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path + " cannot be read");
  return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
}

std::string ReasonOf(const v1::Rejection& rejection) {
  static const std::string kPrefix = "REJECTION_REASON_";
  const std::string name = v1::RejectionReason_Name(rejection.reason());
  return name.empty() ? std::to_string(rejection.reason()) : name.substr(kPrefix.size());
}

}  // namespace mapless
