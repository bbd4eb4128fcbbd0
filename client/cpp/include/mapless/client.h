// A client of mapless: every call of the interface as a method, with deadlines, retries and errors that are types.
//
// Requests and answers are the messages of mapless/v1/*.proto, whose comments give units, ranges and failures. A photograph that
// could not be localized is no error but an answer with `rejection`.
#pragma once

#include <grpcpp/grpcpp.h>

#include <chrono>
#include <functional>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "mapless/v1/geometry.pb.h"
#include "mapless/v1/localization_service.grpc.pb.h"
#include "mapless/v1/reference_service.grpc.pb.h"

namespace mapless {

// How to connect.
struct ConnectOptions {
  // "host:port"; "host1:port,host2:port" of several that share a store: calls take turns, and pass over one that is away.
  std::string address = "localhost:50051";
  // Deadline of a call, with its retries; each call can have another.
  std::chrono::milliseconds timeout{30'000};
  // Until a server has been reached once, a call that finds none fails after this time; 0: at its deadline.
  std::chrono::milliseconds connect_timeout{0};
  // Of one message of AddReferences, which returns when all features are computed.
  std::chrono::milliseconds upload_timeout{300'000};
  // Attempts of a call while the server is away, UNAVAILABLE or lost during the answer; 1 for no retries, 0: until the deadline.
  int max_attempts = 0;
  // Largest message sent or received; the server's own limit (32 by default) holds, too.
  int max_message_mib = 64;
  // Largest message of AddReferences, about, and the most references in one.
  double batch_mib = 8.0;
  int batch_count = 32;
  // Encrypt, and verify the server's certificate: with these authorities (PEM), or the system's where it is empty.
  bool tls = false;
  std::string root_certificates;
  // PEM, for servers that require a client certificate; with tls only.
  std::string client_certificate;
  std::string client_key;
  // Sent with every call; without tls in clear text.
  std::string token;
  // Names this user among those of the token: 1 to 64 of A-Z a-z 0-9 _ . -
  std::string client_id;
};

// A call that failed. Its class says how; `reason` is for programs, stable, UPPER_SNAKE_CASE.
class Error : public std::runtime_error {
 public:
  // Of a status that is not OK, with the details of google.rpc; `id` is the call's, where they have none.
  Error(const grpc::Status& status, const std::string& id);

  grpc::StatusCode code;
  std::string reason;
  // The server's sentence for a person.
  std::string message;
  // Path of the wrong field in the request, "intrinsics.focal_x_px"; empty if it is none.
  std::string field;
  // The scene or reference that does not exist, or exists already; else empty.
  std::string resource;
  // Finds the call in the server's log; empty if the call did not reach it.
  std::string request_id;
  // When the server asks for another attempt.
  std::optional<std::chrono::milliseconds> retry_after;
};

// The request is wrong: a bad image, camera, pose, name or field.
struct InvalidArgument : Error { using Error::Error; };
// The server requires a token, and it is missing, wrong or expired.
struct Unauthenticated : Error { using Error::Error; };
// The token's role does not include the call.
struct PermissionDenied : Error { using Error::Error; };
// The scene or the reference does not exist.
struct NotFound : Error { using Error::Error; };
// The id is taken.
struct AlreadyExists : Error { using Error::Error; };
// The server's configuration or state does not permit the call.
struct FailedPrecondition : Error { using Error::Error; };
// Too many calls wait (`retry_after` is set), or the message is larger than the server's limit.
struct ResourceExhausted : Error { using Error::Error; };
// No answer arrived before the deadline.
struct DeadlineExceeded : Error { using Error::Error; };
// The server cannot be reached, starts or drains; all retries failed.
struct Unavailable : Error { using Error::Error; };
// A stored reference is damaged.
struct DataLoss : Error { using Error::Error; };
// A fault of the server; its log has more under `request_id`.
struct Internal : Error { using Error::Error; };

// A connection to a server; use it from any thread, and end it after its calls. Connects with the first call. Every method throws
// Error. A `timeout` of zero is that of the options.
//
// A call outlives a restart of the server: it is repeated until its deadline, with a pause that doubles from 0.2 to 2 s. Where the
// answer to a change was lost, what is stored is compared with what was to be stored, and is success if it is the same, as is the
// absence of what was to be deleted. What another attempt does not change, such as a certificate, is thrown after four.
class Client {
 public:
  using Timeout = std::chrono::milliseconds;

  explicit Client(ConnectOptions options);
  ~Client();
  Client(Client&&) noexcept;

  // Whether the server takes calls now; false while it starts or drains. Throws after four attempts, about 1.4 s, if it is away.
  bool IsServing(Timeout timeout = {}) const;

  v1::LocalizeResponse Localize(const v1::LocalizeRequest& request, Timeout timeout = {}) const;
  // The final answer; `on_better` gets each better answer before it, in the caller's thread, none or one mostly: localizations
  // in which the server has little trust, and first, where options.allow_coarse is set, a coarse pose that nothing has checked.
  v1::LocalizeResponse LocalizeProgressively(const v1::LocalizeRequest& request,
                                             const std::function<void(const v1::LocalizeResponse&)>& on_better,
                                             Timeout timeout = {}) const;
  v1::LocalizeRigResponse LocalizeRig(const v1::LocalizeRigRequest& request, Timeout timeout = {}) const;
  v1::LocalizeSequenceResponse LocalizeSequence(const v1::LocalizeSequenceRequest& request, Timeout timeout = {}) const;

  v1::Scene CreateScene(const v1::CreateSceneRequest& request, Timeout timeout = {}) const;
  v1::Scene GetScene(const std::string& scene, Timeout timeout = {}) const;
  v1::UpdateSceneResponse UpdateScene(const v1::UpdateSceneRequest& request, Timeout timeout = {}) const;
  std::vector<v1::Scene> ListScenes(Timeout timeout = {}) const;
  void DeleteScene(const std::string& scene, Timeout timeout = {}) const;

  v1::CreateReferenceResponse CreateReference(const v1::CreateReferenceRequest& request, Timeout timeout = {}) const;
  // Stores many references, in as many messages as needed; each message is stored whole or not at all. `on_progress` gets the
  // number stored so far.
  std::vector<v1::Reference> AddReferences(const std::string& scene, const std::vector<v1::CreateReferenceRequest>& references,
                                           const std::function<void(std::size_t)>& on_progress = nullptr) const;
  v1::Reference GetReference(const std::string& scene, const std::string& reference, bool include_image = false,
                             Timeout timeout = {}) const;
  // All references of a scene, without photographs; `timeout` is that of each page.
  std::vector<v1::Reference> ListReferences(const std::string& scene, Timeout timeout = {}) const;
  void DeleteReference(const std::string& scene, const std::string& reference, Timeout timeout = {}) const;

  v1::RetrieveReferencesResponse RetrieveReferences(const v1::RetrieveReferencesRequest& request, Timeout timeout = {}) const;
  // One page: the answer's `next_page_token` is for the next request.
  v1::AuditSceneResponse AuditScene(const v1::AuditSceneRequest& request, Timeout timeout = {}) const;
  v1::CheckCoverageResponse CheckCoverage(const v1::CheckCoverageRequest& request, Timeout timeout = {}) const;

 private:
  // `find` fills the response of a change whose answer was lost, in the time left; false if the server's error is right.
  template <class Stub, class Request, class Response>
  Response Unary(grpc::Status (Stub::*method)(grpc::ClientContext*, const Request&, Response*), const Request& request,
                 Timeout timeout, const std::function<bool(Response&, Timeout)>& find = nullptr) const;
  bool Stored(const std::string& scene, const v1::CreateReferenceRequest& wanted, v1::Reference& stored, Timeout timeout) const;
  void Prepare(grpc::ClientContext& context, const google::protobuf::Message& request,
               std::chrono::system_clock::time_point deadline) const;

  ConnectOptions options_;
  std::unique_ptr<class Servers> servers_;
};

// A pinhole camera; (0, 0) is the centre of the top-left pixel.
v1::CameraIntrinsics Pinhole(int width_px, int height_px, double focal_x_px, double focal_y_px, double principal_x_px,
                             double principal_y_px);
// Depth that a sensor measured, for `depth` of a LocalizeRequest or Reference, of the photograph's camera, scaled; set `intrinsics`
// and `camera_from_depth_camera` where it is of another one. A PNG with one channel of 16 bits; 1 is `unit_m`, 0 is no value.
v1::DepthImage DepthPng(std::string png, double unit_m = 0.001, v1::DepthSensor sensor = v1::DEPTH_SENSOR_UNSPECIFIED);
// Depth by metres, row by row; 0, NaN and infinity are no value. std::invalid_argument if there are not width times height.
v1::DepthImage DepthMetres(const std::vector<float>& metres, int width_px, int height_px,
                           v1::DepthSensor sensor = v1::DEPTH_SENSOR_UNSPECIFIED);
// A pose by its quaternion and translation, world_from_camera.
v1::RigidTransform Pose(double qx, double qy, double qz, double qw, double x_m, double y_m, double z_m);
// The bytes of a file; std::runtime_error names one that cannot be read.
std::string ReadFile(const std::string& path);
// Why a photograph was not localized, "TOO_FEW_MATCHES"; a number for a reason that is newer than this client.
std::string ReasonOf(const v1::Rejection& rejection);

}  // namespace mapless
