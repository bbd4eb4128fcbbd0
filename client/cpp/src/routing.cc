#include "routing.h"

#include <algorithm>
#include <cctype>
#include <cstdio>
#include <map>

#include "mapless/v1/localization_service.pb.h"

namespace mapless {
namespace {

// Of a group's labels; metadata is limited to some KB, and a call without a scene goes anywhere.
constexpr std::size_t kMaxLabels = 200;

bool IsVisible(const std::string& text) {
  return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) { return c > ' ' && c < '\x7f'; });
}

std::string Quoted(const std::string& text) {
  std::string quoted;
  for (const unsigned char c : text) {
    if (std::isalnum(c) || c == '_' || c == '.' || c == '-' || c == '~') {
      quoted += static_cast<char>(c);
    } else if (c == ' ') {
      quoted += '+';
    } else {
      char code[4];
      std::snprintf(code, sizeof code, "%%%02X", c);
      quoted += code;
    }
  }
  return quoted;
}

std::string GroupOf(const v1::SceneGroup& group) {
  std::string labels;
  for (const auto& [name, value] : std::map<std::string, std::string>(group.labels().begin(), group.labels().end()))
    labels += (labels.empty() ? "" : "&") + Quoted(name) + "=" + Quoted(value);
  return labels.size() <= kMaxLabels ? "scenes?" + labels : "";
}

std::string NameIn(const google::protobuf::Message& request) {
  const auto* reflection = request.GetReflection();
  const auto* group = request.GetDescriptor()->FindFieldByName("scene_group");
  if (group != nullptr && reflection->HasField(request, group))
    return GroupOf(static_cast<const v1::SceneGroup&>(reflection->GetMessage(request, group)));
  if (const auto* several = request.GetDescriptor()->FindFieldByName("scenes"); several != nullptr && several->is_repeated()) {
    std::string first;
    for (int i = 0; i < reflection->FieldSize(request, several); ++i) {
      const std::string name = reflection->GetRepeatedString(request, several, i);
      first = i == 0 ? name : std::min(first, name);
    }
    if (!first.empty()) return first;
  }
  for (const char* name : {"scene", "name", "scene_id"}) {
    const auto* field = request.GetDescriptor()->FindFieldByName(name);
    if (field == nullptr) continue;
    if (field->cpp_type() == google::protobuf::FieldDescriptor::CPPTYPE_MESSAGE)  // the scene itself
      return NameIn(reflection->GetMessage(request, field));
    std::string value = reflection->GetString(request, field);
    if (std::string(name) == "scene_id") return value.empty() ? "" : "scenes/" + value;
    return value.substr(0, value.find("/references/"));
  }
  return "";
}

}  // namespace

std::string SceneOf(const google::protobuf::Message& request) {
  std::string name = NameIn(request);
  return IsVisible(name) ? name : "";
}

}  // namespace mapless
