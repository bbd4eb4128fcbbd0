#include "mapless/client.h"

#include <algorithm>
#include <fstream>
#include <future>
#include <iterator>
#include <utility>

#include <grpcpp/generic/generic_stub.h>

#include "mapless/client/wire.pb.h"

namespace mapless {
namespace {

constexpr int kReconnectMs = 200;
constexpr int kMaxReconnectMs = 2'000;
constexpr int kKeepaliveMs = 60'000;
constexpr int kKeepaliveTimeoutMs = 10'000;
constexpr int kPageSize = 1'000;
constexpr char kHealth[] = "/grpc.health.v1.Health/Check";
constexpr int kServing = 1;

// Methods that change nothing, which gRPC may repeat.
constexpr const char* kReading[] = {
    "mapless.v1.LocalizationService", "Localize",         "mapless.v1.LocalizationService", "LocalizeProgressively",
    "mapless.v1.LocalizationService", "LocalizeRig",      "mapless.v1.LocalizationService", "LocalizeSequence",
    "mapless.v1.ReferenceService",    "GetScene",         "mapless.v1.ReferenceService",    "ListScenes",
    "mapless.v1.ReferenceService",    "GetReference",     "mapless.v1.ReferenceService",    "ListReferences",
    "mapless.v1.ReferenceService",    "RetrieveReferences", "mapless.v1.ReferenceService",  "AuditScene",
    "mapless.v1.ReferenceService",    "CheckCoverage",    "grpc.health.v1.Health",          "Check",
};

std::string ServiceConfig(int max_attempts) {
  std::string config = R"({"loadBalancingConfig": [{"round_robin": {}}])";
  if (max_attempts > 1) {
    config += R"(, "methodConfig": [{"name": [)";
    for (std::size_t i = 0; i < std::size(kReading); i += 2) {
      config += std::string(i ? ", " : "") + R"({"service": ")" + kReading[i] + R"(", "method": ")" + kReading[i + 1] + "\"}";
    }
    config += R"(], "retryPolicy": {"maxAttempts": )" + std::to_string(max_attempts) +
              R"(, "initialBackoff": "0.2s", "maxBackoff": "2s", "backoffMultiplier": 2,)"
              R"( "retryableStatusCodes": ["UNAVAILABLE"]}}])";
  }
  return config + "}";
}

bool IsVisible(const std::string& text) {
  return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) { return c > ' ' && c < '\x7f'; });
}

std::shared_ptr<grpc::Channel> Connect(const ConnectOptions& options) {
  if (options.max_attempts < 1 || options.max_attempts > 5) throw std::invalid_argument("max_attempts must be 1 to 5");
  if (options.max_message_mib < 1 || options.max_message_mib > 2047)
    throw std::invalid_argument("max_message_mib must be 1 to 2047");
  if (options.batch_count < 1 || !(options.batch_mib > 0)) throw std::invalid_argument("batches must not be empty");
  if (options.address.find("://") != std::string::npos)
    throw std::invalid_argument("an address is host:port, without scheme, is " + options.address);
  // gRPC ends the program where metadata has anything else, such as the line break at the end of a token's file.
  for (const auto& [name, value] : {std::pair("token", options.token), std::pair("client_id", options.client_id)})
    if (!value.empty() && !IsVisible(value))
      throw std::invalid_argument(std::string(name) + " must be visible ASCII characters, without spaces or line breaks");
  const int max_bytes = options.max_message_mib << 20;
  grpc::ChannelArguments arguments;
  arguments.SetMaxSendMessageSize(max_bytes);
  arguments.SetMaxReceiveMessageSize(max_bytes);
  arguments.SetServiceConfigJSON(ServiceConfig(options.max_attempts));
  arguments.SetInt(GRPC_ARG_INITIAL_RECONNECT_BACKOFF_MS, kReconnectMs);
  arguments.SetInt(GRPC_ARG_MAX_RECONNECT_BACKOFF_MS, kMaxReconnectMs);
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, kKeepaliveMs);
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, kKeepaliveTimeoutMs);
  // A call is only repeated while its message fits, by default 256 KiB: less than a photograph.
  arguments.SetInt(GRPC_ARG_PER_RPC_RETRY_BUFFER_SIZE, max_bytes);
  std::shared_ptr<grpc::ChannelCredentials> credentials = grpc::InsecureChannelCredentials();
  if (options.tls) {
    grpc::SslCredentialsOptions tls;
    tls.pem_root_certs = options.root_certificates;
    tls.pem_cert_chain = options.client_certificate;
    tls.pem_private_key = options.client_key;
    credentials = grpc::SslCredentials(tls);
  }
  return grpc::CreateCustomChannel(options.address, credentials, arguments);
}

// The scene of a request, "scenes/{scene}", for load balancers in front of several servers; empty where there is none.
std::string SceneOf(const google::protobuf::Message& request) {
  const auto* reflection = request.GetReflection();
  for (const char* name : {"scene", "name", "scene_id"}) {
    const auto* field = request.GetDescriptor()->FindFieldByName(name);
    if (field == nullptr) continue;
    if (field->cpp_type() == google::protobuf::FieldDescriptor::CPPTYPE_MESSAGE)  // the scene itself
      return SceneOf(reflection->GetMessage(request, field));
    std::string value = reflection->GetString(request, field);
    if (std::string(name) == "scene_id") return value.empty() ? "" : "scenes/" + value;
    return value.substr(0, value.find("/references/"));
  }
  return "";
}

[[noreturn]] void Throw(const grpc::Status& status, const grpc::ClientContext& context) {
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

Client::Client(ConnectOptions options)
    : options_(std::move(options)),
      channel_(Connect(options_)),
      localization_(v1::LocalizationService::NewStub(channel_)),
      references_(v1::ReferenceService::NewStub(channel_)) {}

void Client::Prepare(grpc::ClientContext& context, const google::protobuf::Message& request, Timeout timeout) const {
  context.set_deadline(std::chrono::system_clock::now() + (timeout == Timeout{} ? options_.timeout : timeout));
  if (!options_.token.empty()) context.AddMetadata("authorization", "Bearer " + options_.token);
  if (!options_.client_id.empty()) context.AddMetadata("x-client-id", options_.client_id);
  if (const std::string scene = SceneOf(request); IsVisible(scene)) context.AddMetadata("x-mapless-scene", scene);
}

template <class Stub, class Request, class Response>
Response Client::Unary(Stub& stub, grpc::Status (Stub::*method)(grpc::ClientContext*, const Request&, Response*),
                       const Request& request, Timeout timeout) const {
  grpc::ClientContext context;
  Prepare(context, request, timeout);
  Response response;
  const grpc::Status status = (stub.*method)(&context, request, &response);
  if (!status.ok()) Throw(status, context);
  return response;
}

bool Client::IsServing(Timeout timeout) const {
  grpc::ClientContext context;
  client::HealthCheckRequest request;
  client::HealthCheckResponse response;
  Prepare(context, request, timeout);
  grpc::TemplatedGenericStub<client::HealthCheckRequest, client::HealthCheckResponse> stub(channel_);
  std::promise<grpc::Status> ended;
  stub.UnaryCall(&context, kHealth, grpc::StubOptions(), &request, &response,
                 [&ended](grpc::Status status) { ended.set_value(std::move(status)); });
  const grpc::Status status = ended.get_future().get();
  if (!status.ok()) Throw(status, context);
  return response.status() == kServing;
}

using Localizing = v1::LocalizationService::Stub;
using Referencing = v1::ReferenceService::Stub;

v1::LocalizeResponse Client::Localize(const v1::LocalizeRequest& request, Timeout timeout) const {
  return Unary(*localization_, &Localizing::Localize, request, timeout);
}

v1::LocalizeResponse Client::LocalizeProgressively(const v1::LocalizeRequest& request,
                                                   const std::function<void(const v1::LocalizeResponse&)>& on_coarse,
                                                   Timeout timeout) const {
  grpc::ClientContext context;  // the call is cancelled where `on_coarse` throws
  Prepare(context, request, timeout);
  const auto reader = localization_->LocalizeProgressively(&context, request);
  v1::LocalizeProgressivelyResponse message;
  std::optional<v1::LocalizeResponse> answer;
  try {
    while (reader->Read(&message)) {
      if (message.is_final()) {
        answer = message.answer();
      } else if (on_coarse) {
        on_coarse(message.answer());
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
  Throw(status, context);
}

v1::LocalizeRigResponse Client::LocalizeRig(const v1::LocalizeRigRequest& request, Timeout timeout) const {
  return Unary(*localization_, &Localizing::LocalizeRig, request, timeout);
}

v1::LocalizeSequenceResponse Client::LocalizeSequence(const v1::LocalizeSequenceRequest& request, Timeout timeout) const {
  return Unary(*localization_, &Localizing::LocalizeSequence, request, timeout);
}

v1::Scene Client::CreateScene(const v1::CreateSceneRequest& request, Timeout timeout) const {
  return Unary(*references_, &Referencing::CreateScene, request, timeout).scene();
}

v1::Scene Client::GetScene(const std::string& scene, Timeout timeout) const {
  v1::GetSceneRequest request;
  request.set_name("scenes/" + scene);
  return Unary(*references_, &Referencing::GetScene, request, timeout).scene();
}

v1::UpdateSceneResponse Client::UpdateScene(const v1::UpdateSceneRequest& request, Timeout timeout) const {
  return Unary(*references_, &Referencing::UpdateScene, request, timeout);
}

std::vector<v1::Scene> Client::ListScenes(Timeout timeout) const {
  std::vector<v1::Scene> scenes;
  v1::ListScenesRequest request;
  request.set_page_size(kPageSize);
  do {
    const auto page = Unary(*references_, &Referencing::ListScenes, request, timeout);
    scenes.insert(scenes.end(), page.scenes().begin(), page.scenes().end());
    request.set_page_token(page.next_page_token());
  } while (!request.page_token().empty());
  return scenes;
}

void Client::DeleteScene(const std::string& scene, Timeout timeout) const {
  v1::DeleteSceneRequest request;
  request.set_name("scenes/" + scene);
  Unary(*references_, &Referencing::DeleteScene, request, timeout);
}

v1::CreateReferenceResponse Client::CreateReference(const v1::CreateReferenceRequest& request, Timeout timeout) const {
  return Unary(*references_, &Referencing::CreateReference, request,
               timeout == Timeout{} ? options_.upload_timeout : timeout);
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
    const auto done = Unary(*references_, &Referencing::BatchCreateReferences, batch, options_.upload_timeout);
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
  return Unary(*references_, &Referencing::GetReference, request, timeout).reference();
}

std::vector<v1::Reference> Client::ListReferences(const std::string& scene, Timeout timeout) const {
  std::vector<v1::Reference> references;
  v1::ListReferencesRequest request;
  request.set_scene("scenes/" + scene);
  request.set_page_size(kPageSize);
  do {
    const auto page = Unary(*references_, &Referencing::ListReferences, request, timeout);
    references.insert(references.end(), page.references().begin(), page.references().end());
    request.set_page_token(page.next_page_token());
  } while (!request.page_token().empty());
  return references;
}

void Client::DeleteReference(const std::string& scene, const std::string& reference, Timeout timeout) const {
  v1::DeleteReferenceRequest request;
  request.set_name("scenes/" + scene + "/references/" + reference);
  Unary(*references_, &Referencing::DeleteReference, request, timeout);
}

v1::RetrieveReferencesResponse Client::RetrieveReferences(const v1::RetrieveReferencesRequest& request,
                                                          Timeout timeout) const {
  return Unary(*references_, &Referencing::RetrieveReferences, request, timeout);
}

v1::AuditSceneResponse Client::AuditScene(const v1::AuditSceneRequest& request, Timeout timeout) const {
  return Unary(*references_, &Referencing::AuditScene, request, timeout);
}

v1::CheckCoverageResponse Client::CheckCoverage(const v1::CheckCoverageRequest& request, Timeout timeout) const {
  return Unary(*references_, &Referencing::CheckCoverage, request, timeout);
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
