#include "svort_ros/ros/replay.h"

int main(int argc, char** argv) { return svort_ros::run_nifti_to_bag(argc, argv); }
