#pragma once

#include <torch/types.h>

#include "svort_ros/registration/registration_input.h"
#include "svort_ros/sequence/slice_sequence.h"

namespace svort {

/// Pixels of one prepared slice as they were prepared, not divided by the scale: 1 x 1 x h x w, float32.
torch::Tensor pixel_tensor(const PreparedSlice& slice);

/// The prepared slices of a sequence, in its order.
struct SequenceTensors {
  torch::Tensor pixels;  ///< n x 1 x h x w, float32, intensity divided by the sequence's scale, 0 off the brain
  torch::Tensor masks;   ///< n x 1 x h x w, bool: the brain pixels
};

/// @throws std::invalid_argument if the sequence is empty
SequenceTensors sequence_tensors(const SliceSequence& sequence);

/// A sequence as registration takes it: the crops' nominal poses in the scanner's axes, around the first slice's centre
/// (registration needs a fixed origin near the brain, whichever).
/// @throws std::invalid_argument if the sequence is empty
RegistrationInput registration_input(const SliceSequence& sequence);

}  // namespace svort
