#include "svort_ros/ros/simulate.h"

int main(int argc, char** argv) { return svort_ros::run_svort_simulate(argc, argv); }
