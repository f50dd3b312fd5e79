#include "svort_ros/io/accuracy_table.h"

int main(int argc, char** argv) { return svort::run_svort_accuracy(argc, argv); }
