#include "servers.h"

#include <algorithm>
#include <random>
#include <thread>

namespace mapless {
namespace {

constexpr int kReconnectMs = 200;
constexpr int kMaxReconnectMs = 2'000;
constexpr int kKeepaliveMs = 60'000;
constexpr int kKeepaliveTimeoutMs = 10'000;
constexpr double kFirstPauseS = 0.2;
constexpr double kMaxPauseS = 2.0;
constexpr double kJitter = 0.2;
// After so many attempts, what is wrong with certificates or protocol is not waited for any longer.
constexpr int kFewAttempts = 4;
constexpr char kServiceConfig[] = R"({"loadBalancingConfig": [{"round_robin": {}}]})";

double Seconds(std::chrono::nanoseconds time) { return std::chrono::duration<double>(time).count(); }

bool Has(const std::string& text, std::initializer_list<const char*> parts) {
  return std::any_of(parts.begin(), parts.end(), [&](const char* it) { return text.find(it) != std::string::npos; });
}

bool IsUnconnected(const grpc::Status& status) {
  return status.error_code() == grpc::StatusCode::UNAVAILABLE &&
         Has(status.error_message(), {"connections to all backends failing", "failed to connect to all addresses",
                                      "DNS resolution failed", "errors resolving"});
}

bool IsMisconfigured(const grpc::Status& status) {
  return IsUnconnected(status) && Has(status.error_message(), {"SSL_ERROR_SSL", "WRONG_VERSION_NUMBER", "CERTIFICATE_VERIFY_FAILED",
                                                               "Hostname Verification", "ALPN", "SETTINGS frame"});
}

// Of this machine, whatever proxy the environment has.
bool IsLoopback(const std::string& address) {
  const std::string host = address.substr(0, address.rfind(':'));
  return address.rfind("unix:", 0) == 0 || host == "localhost" || host == "[::1]" || host.rfind("127.", 0) == 0;
}

// PEM as editors on Windows write it: TLS libraries overlook a block that follows a byte order mark.
std::string WithoutMarks(std::string pem) {
  for (std::size_t at; (at = pem.find("\xEF\xBB\xBF")) != std::string::npos;) pem.erase(at, 3);
  return pem;
}

std::vector<std::string> AddressesOf(const std::string& text) {
  if (text.find("://") != std::string::npos && text.rfind("dns://", 0) != 0)
    throw std::invalid_argument("an address is host:port, without scheme, is " + text);
  for (const char* scheme : {"ipv4:", "ipv6:", "dns:", "unix:"})
    if (text.rfind(scheme, 0) == 0) return {text};
  std::vector<std::string> found;
  for (std::size_t begin = 0; begin <= text.size();) {
    const std::size_t end = std::min(text.find(',', begin), text.size());
    std::string one = text.substr(begin, end - begin);
    one.erase(std::remove(one.begin(), one.end(), ' '), one.end());
    if (one.empty()) throw std::invalid_argument("an address is host:port or host1:port,host2:port, is \"" + text + "\"");
    if (std::find(found.begin(), found.end(), one) == found.end()) found.push_back(one);
    begin = end + 1;
  }
  return found;
}

bool IsVisible(const std::string& text) {
  return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) { return c > ' ' && c < '\x7f'; });
}

void Check(const ConnectOptions& options) {
  if (options.max_attempts < 0) throw std::invalid_argument("max_attempts must be at least 1, or 0 for the deadline alone");
  if (options.max_message_mib < 1 || options.max_message_mib > 2047)
    throw std::invalid_argument("max_message_mib must be 1 to 2047");
  if (options.batch_count < 1 || !(options.batch_mib > 0)) throw std::invalid_argument("batches must not be empty");
  // gRPC ends the program where metadata has anything else, such as the line break at the end of a token's file.
  for (const auto& [name, value] : {std::pair("token", options.token), std::pair("client_id", options.client_id)})
    if (!value.empty() && !IsVisible(value))
      throw std::invalid_argument(std::string(name) + " must be visible ASCII characters, without spaces or line breaks");
}

std::shared_ptr<grpc::Channel> Connect(const ConnectOptions& options, const std::string& address) {
  const int max_bytes = options.max_message_mib << 20;
  grpc::ChannelArguments arguments;
  arguments.SetMaxSendMessageSize(max_bytes);
  arguments.SetMaxReceiveMessageSize(max_bytes);
  arguments.SetServiceConfigJSON(kServiceConfig);
  arguments.SetInt(GRPC_ARG_INITIAL_RECONNECT_BACKOFF_MS, kReconnectMs);
  arguments.SetInt(GRPC_ARG_MAX_RECONNECT_BACKOFF_MS, kMaxReconnectMs);
  arguments.SetInt(GRPC_ARG_DNS_MIN_TIME_BETWEEN_RESOLUTIONS_MS, kMaxReconnectMs);
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, kKeepaliveMs);
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, kKeepaliveTimeoutMs);
  arguments.SetInt(GRPC_ARG_ENABLE_HTTP_PROXY, IsLoopback(address) ? 0 : 1);
  // gRPC repeats a call that reached no handler only while its message fits, by default 256 KiB: less than a photograph.
  arguments.SetInt(GRPC_ARG_PER_RPC_RETRY_BUFFER_SIZE, max_bytes);
  std::shared_ptr<grpc::ChannelCredentials> credentials = grpc::InsecureChannelCredentials();
  if (options.tls) {
    grpc::SslCredentialsOptions tls;
    tls.pem_root_certs = WithoutMarks(options.root_certificates);
    tls.pem_cert_chain = WithoutMarks(options.client_certificate);
    tls.pem_private_key = WithoutMarks(options.client_key);
    credentials = grpc::SslCredentials(tls);
  }
  return grpc::CreateCustomChannel(address, credentials, arguments);
}

double Jitter() {
  thread_local std::mt19937 random{std::random_device{}()};
  return std::uniform_real_distribution<double>(1 - kJitter, 1 + kJitter)(random);
}

}  // namespace

Servers::Servers(const ConnectOptions& options) {
  Check(options);
  for (const std::string& address : AddressesOf(options.address)) {
    all_.push_back(std::make_unique<Server>());
    all_.back()->channel = Connect(options, address);
    all_.back()->localization = v1::LocalizationService::NewStub(all_.back()->channel);
    all_.back()->references = v1::ReferenceService::NewStub(all_.back()->channel);
  }
}

Server& Servers::Next() {
  const auto now = Clock::now().time_since_epoch().count();
  const std::size_t first = turns_++ % all_.size();
  Server* best = nullptr;
  for (std::size_t i = 0; i < all_.size(); ++i) {
    Server* it = all_[(first + i) % all_.size()].get();
    if (best == nullptr || std::max(it->lost_until.load(), now) < std::max(best->lost_until.load(), now)) best = it;
  }
  return *best;
}

Attempts::Attempts(const ConnectOptions& options, Servers& servers, Client::Timeout timeout, int most)
    : options_(options),
      servers_(servers),
      begin_(std::chrono::system_clock::now()),
      deadline_(begin_ + (timeout == Client::Timeout{} ? options.timeout : timeout)),
      most_(options.max_attempts ? options.max_attempts : most) {}

Client::Timeout Attempts::Left() const {
  const auto left = std::chrono::duration_cast<Client::Timeout>(deadline_ - std::chrono::system_clock::now());
  return std::max(left, Client::Timeout{1});
}

void Attempts::Answered(Server& server) {
  servers_.were_reached = true;
  server.lost_until = 0;
}

bool Attempts::Pause(Server& server, const grpc::Status& status, const grpc::ClientContext& context) {
  ++count_;
  const auto code = StatusOf(status, context).error_code();
  const bool is_unconnected = IsUnconnected(status);
  if (code != grpc::StatusCode::UNAVAILABLE && code != grpc::StatusCode::CANCELLED) {
    if (code != grpc::StatusCode::DEADLINE_EXCEEDED) Answered(server);
    return false;
  }
  if (!is_unconnected) servers_.were_reached = true;
  server.lost_until = (Clock::now() + std::chrono::milliseconds(kMaxReconnectMs)).time_since_epoch().count();
  if ((most_ && count_ >= most_) || (count_ >= kFewAttempts && IsMisconfigured(status))) return false;
  auto until = deadline_;
  if (is_unconnected && !servers_.were_reached && options_.connect_timeout != Client::Timeout{})
    until = std::min(until, begin_ + options_.connect_timeout);
  const double left_s = Seconds(until - std::chrono::system_clock::now());
  double pause_s = std::min(kFirstPauseS * static_cast<double>(1 << std::min(count_ - 1, 10)), kMaxPauseS);
  // A server that returns shortly before the deadline is found, too.
  pause_s = std::max(std::min(pause_s, left_s / 2), kFirstPauseS) * Jitter();
  if (pause_s >= left_s) return false;
  may_be_done_ = may_be_done_ || !is_unconnected;  // what was never sent is not done
  std::this_thread::sleep_for(std::chrono::duration<double>(pause_s));
  return true;
}

grpc::Status StatusOf(const grpc::Status& status, const grpc::ClientContext& context) {
  const auto code = status.error_code();
  const bool is_of_server = context.GetServerTrailingMetadata().count("x-request-id") > 0;
  if ((code == grpc::StatusCode::INTERNAL || code == grpc::StatusCode::UNKNOWN) && !is_of_server &&
      Has(status.error_message(), {"RST_STREAM with error code 0", "RST_STREAM with error code 2", "Stream removed",
                                   "Connection reset", "Broken pipe", "Socket closed", "Transport closed", "GOAWAY",
                                   "http2 header with status: 50"}))
    return {grpc::StatusCode::UNAVAILABLE, "the connection broke before the answer: " + status.error_message()};
  return status;
}

}  // namespace mapless
