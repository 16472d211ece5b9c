// Pinocchio without Python in between: `name,seconds` a line, the median of 15 loops. Arguments: URDF and its name.
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/frames.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/parsers/urdf.hpp>
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <vector>

template <class F> double median_s(F f) {
    std::vector<double> all;
    for (int round = 0; round < 15; ++round) {
        auto begin = std::chrono::steady_clock::now();
        for (int i = 0; i < 20000; ++i) f();
        std::chrono::duration<double> took = std::chrono::steady_clock::now() - begin;
        all.push_back(took.count() / 20000);
    }
    std::sort(all.begin(), all.end());
    return all[7];
}

int main(int argc, char **argv) {
    if (argc != 3) return 2;
    pinocchio::Model m;
    pinocchio::urdf::buildModel(argv[1], m);
    pinocchio::Data d(m);
    const auto tip = m.getFrameId("tip");
    srand(1);
    Eigen::VectorXd q = Eigen::VectorXd::Random(m.nq), v = Eigen::VectorXd::Random(m.nv), a = Eigen::VectorXd::Random(m.nv);
    Eigen::Matrix<double, 6, Eigen::Dynamic> J(6, m.nv);
    auto say = [&](const char *what, double s) { std::printf("%s_%s,%.9g\n", what, argv[2], s); };
    say("tip", median_s([&] { pinocchio::forwardKinematics(m, d, q); pinocchio::updateFramePlacement(m, d, tip); }));
    say("jacobian", median_s([&] { J.setZero(); pinocchio::computeFrameJacobian(m, d, q, tip, pinocchio::LOCAL_WORLD_ALIGNED, J); }));
    say("rnea", median_s([&] { pinocchio::rnea(m, d, q, v, a); }));
    say("crba", median_s([&] { pinocchio::crba(m, d, q); }));
    say("aba", median_s([&] { pinocchio::aba(m, d, q, v, a); }));
}
