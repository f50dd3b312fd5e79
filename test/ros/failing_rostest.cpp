// Fails on purpose: ctest expects it to (rostest_failing in CMakeLists.txt).

#include <gtest/gtest.h>

TEST(Guard, FailsOnPurpose) { EXPECT_TRUE(false); }

int main(int argc, char** argv) {
  testing::InitGoogleTest(&argc, argv);
  return RUN_ALL_TESTS();
}
