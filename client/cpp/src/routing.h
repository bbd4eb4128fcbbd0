// Metadata by which load balancers keep the calls of a scene at the server that has it in memory. Not installed.
#pragma once

#include <string>

#include <google/protobuf/message.h>

namespace mapless {

// The scene of a request, "scenes/{scene}"; of several the first by name, of a group "scenes?" with its labels as a query string.
// Empty where there is none, or where it cannot be metadata.
std::string SceneOf(const google::protobuf::Message& request);

}  // namespace mapless
