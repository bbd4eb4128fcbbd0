// The servers of a client, and the attempts of a call: which server, how long, and when again. Not installed.
#pragma once

#include <grpcpp/grpcpp.h>

#include <atomic>
#include <chrono>
#include <memory>
#include <string>
#include <vector>

#include "mapless/client.h"

namespace mapless {

using Clock = std::chrono::steady_clock;

// One server, or several behind one name.
struct Server {
  v1::LocalizationService::Stub* Of(const v1::LocalizationService::Stub*) const { return localization.get(); }
  v1::ReferenceService::Stub* Of(const v1::ReferenceService::Stub*) const { return references.get(); }

  std::shared_ptr<grpc::Channel> channel;
  std::unique_ptr<v1::LocalizationService::Stub> localization;
  std::unique_ptr<v1::ReferenceService::Stub> references;
  std::atomic<Clock::rep> lost_until{0};
};

// Those of the addresses "host1:port,host2:port", for any number of threads: calls take turns, and pass over a server that was
// lost a moment ago.
class Servers {
 public:
  explicit Servers(const ConnectOptions& options);  // std::invalid_argument where an option is wrong

  Server& Next();

  std::atomic<bool> were_reached{false};

 private:
  std::vector<std::unique_ptr<Server>> all_;
  std::atomic<unsigned> turns_{0};
};

// The attempts of one call, which share its deadline.
class Attempts {
 public:
  Attempts(const ConnectOptions& options, Servers& servers, Client::Timeout timeout, int most = 0);

  std::chrono::system_clock::time_point Deadline() const { return deadline_; }
  Client::Timeout Left() const;
  // Whether an attempt whose answer was lost may have been carried out.
  bool MayBeDone() const { return may_be_done_; }
  // What the server has answered, if only an error.
  void Answered(Server& server);
  // Waits before the next attempt; false where there is none: another would not help, or would be too late.
  bool Pause(Server& server, const grpc::Status& status, const grpc::ClientContext& context);

 private:
  const ConnectOptions& options_;
  Servers& servers_;
  std::chrono::system_clock::time_point begin_, deadline_;
  int most_;
  int count_ = 0;
  bool may_be_done_ = false;
};

// The status of an error for its caller: UNAVAILABLE where gRPC has made INTERNAL or UNKNOWN of a connection that broke.
grpc::Status StatusOf(const grpc::Status& status, const grpc::ClientContext& context);

}  // namespace mapless
