#include "svort_ros/live/sequence_tensors.h"

#include <torch/types.h>

#include <algorithm>
#include <stdexcept>

namespace svort {

torch::Tensor pixel_tensor(const PreparedSlice& slice) {
  torch::Tensor pixels = torch::empty({1, 1, slice.size, slice.size}, torch::kFloat32);
  std::copy(slice.pixels.begin(), slice.pixels.end(), pixels.data_ptr<float>());
  return pixels;
}

SequenceTensors sequence_tensors(const SliceSequence& sequence) {
  const auto& slices = sequence.slices();
  if (slices.empty()) throw std::invalid_argument("sequence_tensors: the sequence holds no slice");
  const auto count = static_cast<std::int64_t>(slices.size());
  const std::int64_t size = sequence.options().size_px;
  const auto intensity = static_cast<float>(1. / sequence.intensity_scale());
  SequenceTensors tensors;
  tensors.pixels = torch::empty({count, 1, size, size}, torch::kFloat32);
  tensors.masks = torch::empty({count, 1, size, size}, torch::kBool);
  float* pixel = tensors.pixels.data_ptr<float>();
  bool* brain = tensors.masks.data_ptr<bool>();
  for (const auto& slice : slices) {
    pixel = std::transform(slice->pixels.begin(), slice->pixels.end(), pixel,
                           [intensity](float value) { return value * intensity; });
    brain =
        std::transform(slice->mask.begin(), slice->mask.end(), brain, [](std::uint8_t value) { return value != 0; });
  }
  return tensors;
}

RegistrationInput registration_input(const SliceSequence& sequence) {
  const SequenceTensors tensors = sequence_tensors(sequence);
  const auto& slices = sequence.slices();
  RegistrationInput input;
  input.slices = tensors.pixels;
  input.masks = tensors.masks;
  input.resolution_mm = sequence.options().resolution_mm;
  const Eigen::Vector3d centre = slices.front()->info.T_scanner_slice.translation();
  for (const auto& slice : slices) {
    Pose nominal = slice->info.T_scanner_slice * slice->T_slice_crop;
    nominal.translation() -= centre;
    input.T_world_slice.push_back(nominal);
    input.stack.push_back(slice->info.stack);
    input.time_s.push_back(static_cast<double>(slice->info.stamp_ns - slices.front()->info.stamp_ns) * 1e-9);
    input.thickness_mm.push_back(slice->info.thickness);
  }
  return input;
}

}  // namespace svort
