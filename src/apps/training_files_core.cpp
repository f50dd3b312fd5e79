#include <stdexcept>

#include "training_files.h"

namespace svort {

std::vector<BrainVolume> read_training_volumes(const std::vector<std::string>& files) {
  std::vector<BrainVolume> volumes;
  for (const std::string& file : files) {
    if (std::filesystem::path(file).extension() != ".pt")
      throw std::runtime_error(file +
                               ": this build of the core alone reads packs of volumes (.pt) only; svort_simulate "
                               "--save-volumes makes them of NIfTI files");
    for (BrainVolume& volume : load_brain_volumes(file)) volumes.push_back(std::move(volume));
  }
  return volumes;
}

void plot_training(const std::filesystem::path& /*folder*/, const std::vector<std::string>& /*parts*/) {}

}  // namespace svort
