#include "svort_ros/io/calibration.h"

int main(int argc, char** argv) { return svort::run_svort_calibrate(argc, argv); }
