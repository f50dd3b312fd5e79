#include "svort_ros/io/evaluation.h"

int main(int argc, char** argv) { return svort::run_svort_evaluate(argc, argv); }
