// Calls a server in every way that the client offers, and checks what comes back: calls ADDRESS PHOTO. The scene of the test in
// Python has references; the photograph is 96x64. With a third argument, the first answer to each method is lost.
#include <mapless/client.h>

#include <cstdio>
#include <cstdlib>
#include <limits>
#include <thread>

using namespace mapless;

namespace {

void Check(bool holds, const char* what) {
  if (holds) return;
  std::fprintf(stderr, "failed: %s\n", what);
  std::exit(1);
}

template <class Expected, class Call>
Expected Fails(Call call, const char* what) {
  try {
    call();
  } catch (const Expected& error) {
    return error;
  } catch (const Error& error) {
    std::fprintf(stderr, "failed: %s: another error: %s\n", what, error.what());
    std::exit(1);
  }
  std::fprintf(stderr, "failed: %s: no error\n", what);
  std::exit(1);
}

// Two metres everywhere, and no value at the first pixel.
v1::DepthImage Depth() {
  std::vector<float> metres(96 * 64, 2.0F);
  metres[0] = std::numeric_limits<float>::quiet_NaN();
  return DepthMetres(metres, 96, 64, v1::DEPTH_SENSOR_STEREO);
}

v1::CreateReferenceRequest Reference(const std::string& id, const std::string& photo, double x_m) {
  v1::CreateReferenceRequest request;
  request.set_reference_id(id);
  request.mutable_reference()->set_image(photo);
  *request.mutable_reference()->mutable_intrinsics() = Pinhole(96, 64, 80, 81, 47.5, 31.5);
  *request.mutable_reference()->mutable_world_from_camera() = Pose(0, 0, 0, 1, x_m, 2, -1);
  return request;
}

void Scenes(const Client& client, const std::string& photo) {
  v1::CreateSceneRequest create;
  create.set_scene_id("cpp");
  Check(client.CreateScene(create).name() == "scenes/cpp", "a scene is created");
  Check(Fails<AlreadyExists>([&] { client.CreateScene(create); }, "twice").resource == "scenes/cpp", "it names the scene");
  std::vector<v1::CreateReferenceRequest> many;
  for (int i = 0; i < 70; ++i) many.push_back(Reference("r" + std::to_string(i), photo, i));
  std::vector<std::size_t> progress;
  Check(client.AddReferences("cpp", many, [&](std::size_t done) { progress.push_back(done); }).size() == 70, "70 are stored");
  Check(progress == std::vector<std::size_t>{32, 64, 70}, "in three messages");
  Check(client.GetScene("cpp").reference_count() == 70, "the scene has them");
  Check(client.ListReferences("cpp").size() == 70, "they are listed");
  Check(client.GetReference("cpp", "r7", true).image() == photo, "a photograph comes back");
  Check(client.CreateReference([&] {
    auto request = Reference("one", photo, 7);
    request.set_scene("scenes/cpp");
    return request;
  }()).reference().feature_count() == 1, "one more");
  client.DeleteReference("cpp", "one");
  auto deep = Reference("deep", photo, 8);
  deep.set_scene("scenes/cpp");
  *deep.mutable_reference()->mutable_depth() = Depth();
  Check(client.CreateReference(deep).reference().depth_sha256().size() == 64, "a reference with depth");
  Check(client.GetReference("cpp", "deep", true).depth().float32() == Depth().float32(), "its depth comes back");
  client.DeleteReference("cpp", "deep");
  const auto lost = Fails<NotFound>([&] { client.GetReference("cpp", "one"); }, "a deleted reference");
  Check(lost.resource == "scenes/cpp/references/one" && !lost.request_id.empty(), "the error names it, and the call");
}

v1::LocalizeRequest Query(const std::string& photo, const std::string& reference = "r3") {
  v1::LocalizeRequest request;
  request.set_scene("scenes/cpp");
  request.set_image(photo);
  request.add_references("scenes/cpp/references/" + reference);
  *request.mutable_intrinsics() = Pinhole(96, 64, 80, 81, 47.5, 31.5);
  return request;
}

void Queries(const Client& client, const std::string& photo) {
  const auto answer = client.Localize(Query(photo));
  Check(answer.has_localization(), "a photograph is localized");
  Check(answer.localization().world_from_camera().translation_m().x() == 3, "where its reference is");
  Check(client.LocalizeProgressively(Query(photo), nullptr).has_localization(), "progressively, too");
  auto anywhere = Query(photo);
  anywhere.clear_scene();
  anywhere.clear_references();
  (*anywhere.mutable_scene_group()->mutable_labels())["site"] = "a & b";
  Check(Fails<NotFound>([&] { client.Localize(anywhere); }, "a group of no scene").field == "scene_group", "the field is named");
  anywhere.mutable_scene_group()->clear_labels();
  Check(client.Localize(anywhere).scene() == "scenes/cpp", "the scene is found among all");
  v1::RetrieveReferencesRequest retrieve;
  retrieve.set_scene("scenes/cpp");
  retrieve.set_image(photo);
  *retrieve.mutable_intrinsics() = Query(photo).intrinsics();
  retrieve.set_count(5);
  Check(client.RetrieveReferences(retrieve).references_size() == 5, "five references resemble it");

  auto wrong = Query(photo);
  wrong.mutable_intrinsics()->set_focal_x_px(-1);
  const auto error = Fails<InvalidArgument>([&] { client.Localize(wrong); }, "a negative focal length");
  Check(error.field == "intrinsics.focal_x_px", "the field is named");
  Check(error.code == grpc::StatusCode::INVALID_ARGUMENT && !error.reason.empty() && !error.message.empty(), "and described");
  auto elsewhere = Query(photo);
  elsewhere.set_scene("scenes/nowhere");
  elsewhere.clear_references();
  Check(Fails<NotFound>([&] { client.LocalizeProgressively(elsewhere, nullptr); }, "no scene").resource == "scenes/nowhere",
        "a stream's error has details, too");
}

void Away(const std::string& photo) {
  ConnectOptions options;
  options.address = "127.0.0.1:1";
  options.timeout = std::chrono::seconds(5);
  options.max_attempts = 3;
  const auto start = std::chrono::steady_clock::now();
  Fails<Unavailable>([&] { Client(options).Localize(Query(photo)); }, "a port without a server");
  const auto took = std::chrono::steady_clock::now() - start;
  Check(took > std::chrono::milliseconds(50) && took < std::chrono::seconds(5), "after retries, within the deadline");
  Check(Fails<Unavailable>([&] { Client(options).IsServing(); }, "nor health").reason == "UNAVAILABLE", "with a reason");
}

// The first answer to each method is lost: changes are looked up, and are success where they were carried out.
void Lost(const Client& client, const std::string& photo) {
  v1::CreateSceneRequest create;
  create.set_scene_id("cpp");
  create.mutable_down_in_world()->set_y(9.81);
  Check(client.CreateScene(create).name() == "scenes/cpp", "a scene is created once");
  create.mutable_down_in_world()->set_x(1);
  Fails<AlreadyExists>([&] { client.CreateScene(create); }, "another of its name");
  auto one = Reference("one", photo, 7);
  *one.mutable_reference()->mutable_depth() = Depth();
  one.set_scene("scenes/cpp");
  Check(client.CreateReference(one).reference().name() == "scenes/cpp/references/one", "a reference is stored once");
  Check(client.AddReferences("cpp", {Reference("a", photo, 1), Reference("b", photo, 2)}).size() == 2, "two, too");
  Check(client.Localize(Query(photo, "a")).has_localization(), "a photograph is localized");
  Check(client.ListReferences("cpp").size() == 3, "all are there");
  client.DeleteReference("cpp", "one");
  client.DeleteScene("cpp");
  Fails<NotFound>([&] { client.GetScene("cpp"); }, "deleted");
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 3 && count != 4) return 2;
  ConnectOptions options;
  if (count == 4) {
    options.address = arguments[1];
    Lost(Client(options), ReadFile(arguments[2]));
    std::puts("well");
    return 0;
  }
  options.address = arguments[1];
  options.client_id = "calls";
  const Client client(options);
  const std::string photo = ReadFile(arguments[2]);
  for (auto member : {&ConnectOptions::token, &ConnectOptions::client_id}) {
    ConnectOptions broken = options;
    broken.*member = "a line\n";
    Fails<std::invalid_argument>([&] { Client{broken}; }, "a line break, with which gRPC would end the program");
  }
  Check(client.IsServing(), "the server serves");
  Scenes(client, photo);
  Queries(client, photo);
  Away(photo);
  Fails<DeadlineExceeded>([&] { client.Localize(Query(photo), std::chrono::milliseconds(1)); }, "a millisecond");
  std::vector<std::thread> threads;  // one client for all
  for (int i = 0; i < 4; ++i)
    threads.emplace_back([&] { Check(client.Localize(Query(photo)).has_localization(), "from any thread"); });
  for (auto& it : threads) it.join();
  options.address = std::string("127.0.0.1:1, ") + arguments[1];  // the first is away
  const Client both(options);
  for (int i = 0; i < 4; ++i) Check(both.Localize(Query(photo)).has_localization(), "by the server that is there");
  client.DeleteScene("cpp");
  Check(client.ListScenes().empty(), "nothing is left");
  std::puts("well");
}
