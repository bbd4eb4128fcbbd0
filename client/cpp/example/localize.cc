// Localizes a photograph: localize ADDRESS SCENE PHOTO WIDTH HEIGHT FX FY CX CY [DEPTH [UNIT_M]], with the PNG of 16 bits of a depth
// camera that is aligned with it, millimetres unless UNIT_M says another. In place of SCENE a label, site=a, finds the scene among those
// that have it; the position is in the world of the scene that is printed. MAPLESS_TOKEN has the token, MAPLESS_CA the file of the
// authority that signed the server's certificate; with it the connection is encrypted.
//
// Exit codes as those of the command `mapless`: 0 localized, 1 the call failed, 2 wrong usage, 3 not localized.
#include <mapless/client.h>

#include <cstdio>
#include <cstdlib>

namespace {

void Print(const mapless::v1::LocalizeResponse& answer) {
  const auto& found = answer.localization();
  const auto& position = found.world_from_camera().translation_m();
  const auto& q = found.world_from_camera().rotation();
  if (answer.diagnostics().searched_scene_count() > 1) std::printf("in %s\n", answer.scene().c_str());
  std::printf("position  %.3f %.3f %.3f m", position.x(), position.y(), position.z());
  if (found.has_accuracy()) std::printf("   within %.1f cm (95 %%)", 100 * found.accuracy().position_95_m());
  std::printf("\nrotation  x %.4f y %.4f z %.4f w %.4f\n", q.x(), q.y(), q.z(), q.w());
}

int Run(int count, char** arguments) {
  mapless::ConnectOptions options;
  options.address = arguments[1];
  options.connect_timeout = std::chrono::seconds(2);  // for a person, who may have mistyped it
  if (const char* token = std::getenv("MAPLESS_TOKEN")) options.token = token;
  if (const char* authority = std::getenv("MAPLESS_CA")) {
    options.tls = true;
    options.root_certificates = mapless::ReadFile(authority);
  }
  const mapless::Client client(options);

  mapless::v1::LocalizeRequest request;
  const std::string where = arguments[2];
  const auto equals = where.find('=');
  if (equals == std::string::npos) {
    request.set_scene("scenes/" + where);
  } else {
    (*request.mutable_scene_group()->mutable_labels())[where.substr(0, equals)] = where.substr(equals + 1);
  }
  request.set_image(mapless::ReadFile(arguments[3]));
  double numbers[6];
  for (int i = 0; i < 6; ++i) numbers[i] = std::stod(arguments[4 + i]);
  *request.mutable_intrinsics() = mapless::Pinhole(static_cast<int>(numbers[0]), static_cast<int>(numbers[1]), numbers[2],
                                                   numbers[3], numbers[4], numbers[5]);
  if (count > 10)
    *request.mutable_depth() = mapless::DepthPng(mapless::ReadFile(arguments[10]), count > 11 ? std::stod(arguments[11]) : 0.001);
  const auto answer = client.LocalizeProgressively(request, [](const mapless::v1::LocalizeResponse& better) {
    std::puts("localized; the final answer follows");
    Print(better);
  });
  if (!answer.has_localization()) {
    const auto& rejection = answer.rejection();
    std::printf("not localized: %s: %s\n", mapless::ReasonOf(rejection).c_str(), rejection.message().c_str());
    return 3;
  }
  std::printf("localized, %d of %d matches agree\n", answer.localization().inlier_count(), answer.localization().match_count());
  Print(answer);
  if (count > 10 && !answer.diagnostics().has_depth_check()) std::puts("the server is older than depth, and has ignored it");
  return 0;
}

}  // namespace

int main(int count, char** arguments) {
  if (count < 10 || count > 12) {
    std::fprintf(stderr, "usage: localize ADDRESS SCENE PHOTO WIDTH HEIGHT FX FY CX CY [DEPTH [UNIT_M]]\n");
    return 2;
  }
  try {
    return Run(count, arguments);
  } catch (const mapless::Unavailable& error) {
    std::fprintf(stderr, "the server cannot be reached: %s\n", error.message.c_str());
    return 1;
  } catch (const mapless::Error& error) {
    std::fprintf(stderr, "%s%s%s\n", error.what(), error.field.empty() ? "" : ", field ", error.field.c_str());
    return 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 2;
  }
}
