// Peer: boost::numeric::odeint, a controlled stepper that lands on every sample.
// odeint PARAMETERS METHOD RTOL ATOL OUTPUT, METHOD dopri5 or fehlberg78; ATOL in units of the drive's linear wave.
#include <cstdlib>
#include <exception>
#include <iostream>

// The headers that are used, one by one: with all of odeint the compiler takes twice as long.
#include <boost/numeric/odeint/integrate/integrate_times.hpp>
#include <boost/numeric/odeint/stepper/controlled_runge_kutta.hpp>
#include <boost/numeric/odeint/stepper/generation/generation_controlled_runge_kutta.hpp>
#include <boost/numeric/odeint/stepper/generation/generation_runge_kutta_dopri5.hpp>
#include <boost/numeric/odeint/stepper/generation/generation_runge_kutta_fehlberg78.hpp>
#include <boost/numeric/odeint/stepper/generation/make_controlled.hpp>
#include <boost/numeric/odeint/stepper/runge_kutta_dopri5.hpp>
#include <boost/numeric/odeint/stepper/runge_kutta_fehlberg78.hpp>

#include "lattice.hpp"

namespace odeint = boost::numeric::odeint;
using State = std::vector<double>;

template <class Stepper>
static void solve(const Lattice &lattice, double rtol, double atol, const std::string &output) {
    Samples samples(lattice);
    State state(lattice.size(), 0.0);
    const std::vector<double> times = sample_times(lattice);
    long evaluations = 0;
    auto system = [&](const State &y, State &f, double t) {
        ++evaluations;
        lattice.derivative(y.data(), f.data(), t);
    };
    auto observer = [&](const State &y, double) { samples.keep(y.data()); };
    const double begin = cpu_seconds();
    const std::size_t steps = odeint::integrate_times(
        odeint::make_controlled(atol, rtol, Stepper()), system, state, times, 2e-3, observer);
    const double seconds = cpu_seconds() - begin;
    samples.write(output);
    report(seconds, static_cast<long>(steps), evaluations);
}

int main(int argc, char **argv) {
    if (argc != 6) {
        std::cerr << "usage: odeint PARAMETERS dopri5|fehlberg78 RTOL ATOL OUTPUT\n";
        return 2;
    }
    try {
        const Lattice lattice(argv[1]);
        const std::string method = argv[2];
        const double rtol = std::atof(argv[3]), atol = std::atof(argv[4]);
        if (method == "dopri5")
            solve<odeint::runge_kutta_dopri5<State>>(lattice, rtol, atol, argv[5]);
        else if (method == "fehlberg78")
            solve<odeint::runge_kutta_fehlberg78<State>>(lattice, rtol, atol, argv[5]);
        else
            throw std::runtime_error("unknown method " + method);
    } catch (const std::exception &error) {
        std::cerr << "odeint: " << error.what() << "\n";
        return 1;
    }
    return 0;
}
