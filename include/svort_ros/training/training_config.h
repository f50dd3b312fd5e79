#pragma once

#include <string>
#include <vector>

#include "svort_ros/network/baselines.h"
#include "svort_ros/network/live_network.h"
#include "svort_ros/network/svort.h"
#include "svort_ros/simulation/scan_simulator.h"
#include "svort_ros/training/recipe.h"
#include "svort_ros/training/trainer.h"

namespace svort {

/// Everything that svort_train needs to know.
struct TrainingConfig {
  std::string kind = "live";          ///< network: live, v1, svrnet or planeinvol
  std::vector<std::string> volumes;   ///< files of brain volumes to train on
  std::vector<std::string> held_out;  ///< files of brain volumes to validate on; none: no validation
  /// One simulator per entry; the steps take turns. More entries of a kind give it a larger share.
  std::vector<std::string> protocols = {"scanner"};
  std::string note;  ///< goes into the weights' provenance: licence of the volumes, for example
  /// Grid of the volume that scans are made from, and that version 1 estimates: voxels along each edge of a cube.
  int volume_px = 64;
  double volume_mm = 2.;       ///< their size, mm
  LiveNetworkOptions network;  ///< of kind live
  SvortOptions svort;          ///< of kind v1
  BaselineOptions baseline;    ///< of the other kinds
  LiveRecipeOptions recipe;    ///< of kind live
  PaperRecipeOptions paper;    ///< of kind v1
  TrainerOptions trainer;
  SimulatorOptions simulator;

  template <class Visitor>
  void visit(Visitor&& v) {
    v("kind", kind, "network: live, v1, svrnet or planeinvol");
    v("volumes", volumes, "files of brain volumes to train on");
    v("held_out", held_out, "files of brain volumes to validate on; none: no validation");
    v("protocols", protocols, "scanner or uniform, see simulator.scanner.protocol; the steps take turns");
    v("note", note, "goes into the weights' provenance, e.g. the licence of the volumes");
    v("volume_px", volume_px, "voxels along each edge of the volume that scans are made from and v1 estimates");
    v("volume_mm", volume_mm, "size of such a voxel, mm");
    v.section("network", network);
    v.section("svort", svort);
    v.section("baseline", baseline);
    v.section("recipe", recipe);
    v.section("paper", paper);
    v.section("trainer", trainer);
    v.section("simulator", simulator);
  }
};

}  // namespace svort
