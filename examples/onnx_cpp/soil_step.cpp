// A network that sgns has exported, stepped along a tool path with onnxruntime alone.
//
// soil_step STEP.onnx DECODE.onnx path.csv forces.csv [times.csv]
//
// path.csv: a line of names, then one pose a frame: x,y,z [m] of the centre of mass and the unit quaternion qx,qy,qz,qw.
// forces.csv: force [N] and torque [N m] by the soil on the tool in every frame. times.csv: time of every step [us].

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdint>
#include <fstream>
#include <iostream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

// What steps one bed. Nothing is allocated from step to step but the session's own memory.
class Soil {
 public:
  Soil(Ort::Env& env, const char* file, const Ort::SessionOptions& options) : session_(env, file, options) {
    const auto size = session_.GetInputTypeInfo(0).GetTensorTypeAndShapeInfo().GetShape().at(1);
    const auto modes = session_.GetOutputTypeInfo(1).GetTensorTypeAndShapeInfo().GetShape();
    if (session_.GetInputCount() != 2 || session_.GetOutputCount() != 4) {
      throw std::runtime_error("this example is of a tool whose whole motion is given, and of one soil");
    }
    state.assign(size, 0.0);  // zeros: the bed has not begun
    next_ = state;
    latent.assign(modes.at(1) * modes.at(2), 0.0);
    latent_shape = {1, modes.at(1), modes.at(2)};
  }

  // Where the tool is one frame from now; the first call says where it begins.
  void step(std::array<double, 7> pose) {
    const std::array<int64_t, 2> state_shape{1, static_cast<int64_t>(state.size())}, pose_shape{1, 7}, load_shape{1, 3};
    const std::array<Ort::Value, 2> inputs{tensor(state.data(), state.size(), state_shape),
                                           tensor(pose.data(), pose.size(), pose_shape)};
    std::array<Ort::Value, 4> outputs{tensor(next_.data(), next_.size(), state_shape),
                                      tensor(latent.data(), latent.size(), latent_shape),
                                      tensor(force.data(), force.size(), load_shape),
                                      tensor(torque.data(), torque.size(), load_shape)};
    const char* names_in[] = {"state", "pose"};
    const char* names_out[] = {"next_state", "latent", "force", "torque"};
    session_.Run(Ort::RunOptions{nullptr}, names_in, inputs.data(), 2, names_out, outputs.data(), 4);
    state.swap(next_);
  }

  std::string about(const char* key) {
    Ort::AllocatorWithDefaultOptions allocator;
    const auto text = session_.GetModelMetadata().LookupCustomMetadataMapAllocated(key, allocator);
    return text ? text.get() : "";
  }

  std::vector<double> state, latent;  // keep a copy of `state` to come back to it
  std::array<int64_t, 3> latent_shape{};
  std::array<double, 3> force{}, torque{};

 private:
  template <typename Shape>
  Ort::Value tensor(double* data, size_t size, const Shape& shape) {
    return Ort::Value::CreateTensor<double>(memory_, data, size, shape.data(), shape.size());
  }

  Ort::Session session_;
  Ort::MemoryInfo memory_ = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
  std::vector<double> next_;
};

// Positions of all particles [m], x y z of one after another.
std::vector<float> decoded(Ort::Session& session, Soil& soil) {
  const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
  const Ort::Value latent = Ort::Value::CreateTensor<double>(memory, soil.latent.data(), soil.latent.size(),
                                                             soil.latent_shape.data(), soil.latent_shape.size());
  const char* name_in[] = {"latent"};
  const char* name_out[] = {"soil"};
  const auto found = session.Run(Ort::RunOptions{nullptr}, name_in, &latent, 1, name_out, 1);
  const float* first = found[0].GetTensorData<float>();
  return {first, first + found[0].GetTensorTypeAndShapeInfo().GetElementCount()};
}

std::vector<std::array<double, 7>> read_path(const char* file) {
  std::ifstream stream(file);
  std::string line, cell;
  std::getline(stream, line);
  std::vector<std::array<double, 7>> path;
  while (std::getline(stream, line)) {
    std::istringstream cells(line);
    std::array<double, 7> pose{};
    for (double& value : pose) {
      if (!std::getline(cells, cell, ',')) throw std::runtime_error(std::string(file) + ": a line has no 7 numbers");
      value = std::stod(cell);
    }
    path.push_back(pose);
  }
  if (path.empty()) throw std::runtime_error(std::string(file) + ": no poses");
  return path;
}

}  // namespace

int main(int count, char** arguments) try {
  if (count != 5 && count != 6) {
    std::cerr << "usage: soil_step STEP.onnx DECODE.onnx path.csv forces.csv [times.csv]\n";
    return 2;
  }
  Ort::Env env(ORT_LOGGING_LEVEL_WARNING, "soil_step");
  Ort::SessionOptions options;
  options.SetIntraOpNumThreads(1);  // a step is too short for more
  Soil soil(env, arguments[1], options);
  Ort::Session decode(env, arguments[2], options);
  const auto path = read_path(arguments[3]);

  std::ofstream table(arguments[4]);
  table.precision(12);
  table << "Fx,Fy,Fz,Tx,Ty,Tz\n";
  std::vector<double> times;
  for (const auto& pose : path) {
    const auto began = std::chrono::steady_clock::now();
    soil.step(pose);
    times.push_back(std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - began).count());
    table << soil.force[0] << ',' << soil.force[1] << ',' << soil.force[2] << ',' << soil.torque[0] << ','
          << soil.torque[1] << ',' << soil.torque[2] << '\n';
  }
  if (count == 6) {
    std::ofstream stream(arguments[5]);
    for (const double time : times) stream << time << '\n';
  }
  std::sort(times.begin(), times.end());
  const auto particles = decoded(decode, soil);
  std::cout << path.size() << " frames at " << std::stod(soil.about("frame_rate")) << " Hz; a step takes "
            << times[times.size() / 2] << " us (median), " << times[times.size() * 99 / 100] << " us (99 %)\n"
            << particles.size() / 3 << " particles\n";
  return 0;
} catch (const std::exception& error) {
  std::cerr << "soil_step: " << error.what() << '\n';
  return 2;
}
