#include "svort_ros/ros/stack_player.h"

int main(int argc, char** argv) { return svort_ros::run_stack_player(argc, argv); }
