#include "svort_ros/ros/replay.h"

int main(int argc, char** argv) { return svort_ros::run_svort_replay(argc, argv); }
