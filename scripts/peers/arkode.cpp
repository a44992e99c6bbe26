// Peer: SUNDIALS ARKODE's explicit Runge-Kutta with its root finding, by which it ends a step at every contact change.
// arkode PARAMETERS METHOD RTOL ATOL OUTPUT, METHOD a table's name; ATOL in units of the drive's linear wave.
//
// Debian's library is compiled without optimisation: the vector operations of a step are replaced by those below.
//
// Which sites touch is fixed during a step, so that neither its error estimate nor its interpolant meets a kink. Where
// the root finding reports a change, the step is repeated up to it: the interpolant is of lower order than the step.
#include <algorithm>
#include <cstdlib>
#include <exception>
#include <iostream>
#include <string>

#include <arkode/arkode_erkstep.h>
#include <nvector/nvector_serial.h>
#include <sundials/sundials_context.h>

#include "lattice.hpp"

static void check(int flag, const char *call) {
    if (flag < 0) throw std::runtime_error(std::string(call) + " returned " + std::to_string(flag));
}

static void scale(realtype factor, N_Vector from, N_Vector to) {
    const double *in = N_VGetArrayPointer(from);
    double *out = N_VGetArrayPointer(to);
    const sunindextype size = N_VGetLength(to);
    for (sunindextype i = 0; i < size; ++i) out[i] = factor * in[i];
}

// sum = factors[0] terms[0] + ..., where the sum may be the first term itself; piece by piece, each of which stays in
// the first-level cache while all terms are added.
static int linear_combination(int count, realtype *factors, N_Vector *terms, N_Vector sum) {
    constexpr sunindextype piece = 512;
    const sunindextype size = N_VGetLength(sum);
    for (sunindextype begin = 0; begin < size; begin += piece) {
        const sunindextype end = std::min(begin + piece, size);
        double *__restrict out = N_VGetArrayPointer(sum);
        const double *first = N_VGetArrayPointer(terms[0]);
        for (sunindextype i = begin; i < end; ++i) out[i] = factors[0] * first[i];
        for (int k = 1; k < count; ++k) {
            const double factor = factors[k];
            const double *__restrict term = N_VGetArrayPointer(terms[k]);
            for (sunindextype i = begin; i < end; ++i) out[i] += factor * term[i];
        }
    }
    return 0;
}

static realtype rms_norm(N_Vector values, N_Vector weights) {
    const sunindextype size = N_VGetLength(values);
    const double *x = N_VGetArrayPointer(values), *w = N_VGetArrayPointer(weights);
    double total = 0;
#pragma omp simd reduction(+ : total)
    for (sunindextype i = 0; i < size; ++i) total += (x[i] * w[i]) * (x[i] * w[i]);
    return std::sqrt(total / static_cast<double>(size));
}

class Solver {
  public:
    Solver(const Lattice &lattice, const char *method, double rtol, double atol)
        : lattice_(lattice), rtol_(rtol), atol_(atol), held_(lattice.sites().size(), 0) {
        check(SUNContext_Create(nullptr, &context_), "SUNContext_Create");
        state_ = N_VNew_Serial(lattice.size(), context_);
        N_VConst(0.0, state_);
        state_->ops->nvlinearcombination = linear_combination;
        state_->ops->nvscale = scale;
        state_->ops->nvwrmsnorm = rms_norm;
        before_ = N_VClone(state_);
        ark_ = ERKStepCreate(right_hand_side, 0.0, state_, context_);
        check(ERKStepSetTableName(ark_, method), "ERKStepSetTableName");
        check(ERKStepSetUserData(ark_, this), "ERKStepSetUserData");
        check(ERKStepWFtolerances(ark_, weights), "ERKStepWFtolerances");
        check(ERKStepSetMaxNumSteps(ark_, -1), "ERKStepSetMaxNumSteps");
        check(ERKStepSetInitStep(ark_, 2e-3), "ERKStepSetInitStep");
        check(ERKStepRootInit(ark_, static_cast<int>(held_.size()), crossings), "ERKStepRootInit");
        check(ERKStepSetNoInactiveRootWarn(ark_), "ERKStepSetNoInactiveRootWarn");
    }
    Solver(const Solver &) = delete;
    ~Solver() {
        ERKStepFree(&ark_);
        N_VDestroy(before_);
        N_VDestroy(state_);
        SUNContext_Free(&context_);
    }

    const double *state() const { return N_VGetArrayPointer(state_); }

    // Step until `end`, with a step that ends at each contact change on the way.
    void advance(double end) {
        while (time_ < end) {
            const double from = time_;
            N_VScale(1.0, state_, before_);
            check(ERKStepSetStopTime(ark_, end), "ERKStepSetStopTime");
            const int flag = ERKStepEvolve(ark_, end, state_, &time_, ARK_ONE_STEP);
            check(flag, "ERKStepEvolve");
            if (flag == ARK_ROOT_RETURN) land(from);
        }
    }

    void counts(long &steps, long &evaluations) const {
        check(ERKStepGetNumSteps(ark_, &steps), "ERKStepGetNumSteps");
        check(ERKStepGetNumRhsEvals(ark_, &evaluations), "ERKStepGetNumRhsEvals");
    }

  private:
    const Lattice &lattice_;
    double rtol_, atol_;
    std::vector<signed char> held_;
    SUNContext context_ = nullptr;
    N_Vector state_ = nullptr, before_ = nullptr;
    void *ark_ = nullptr;
    double time_ = 0;
    bool landing_ = false;

    static int right_hand_side(realtype t, N_Vector y, N_Vector f, void *pointer) {
        const auto *self = static_cast<Solver *>(pointer);
        self->lattice_.derivative(N_VGetArrayPointer(y), N_VGetArrayPointer(f), t, self->held_.data());
        return 0;
    }

    static int weights(N_Vector y, N_Vector out, void *pointer) {
        const auto *self = static_cast<Solver *>(pointer);
        const double *state = N_VGetArrayPointer(y);
        double *weight = N_VGetArrayPointer(out);
        for (int i = 0; i < self->lattice_.size(); ++i) weight[i] = 1 / (self->rtol_ * std::abs(state[i]) + self->atol_);
        return 0;
    }

    // The functions whose roots end a step: the indentation of every site, without roots while land() repeats a step.
    static int crossings(realtype, N_Vector y, realtype *indentations, void *pointer) {
        const auto *self = static_cast<Solver *>(pointer);
        const double *state = N_VGetArrayPointer(y);
        for (std::size_t i = 0; i < self->held_.size(); ++i) {
            const Site &site = self->lattice_.sites()[i];
            const double w = state[site.resonator] - state[site.host];
            const int side = self->held_[i];
            indentations[i] = self->landing_ ? 1.0 : (side ? side * w : std::abs(w)) - site.clearance;
        }
        return 0;
    }

    // Go back to the time `from`, step to the change that the root finding reported, and change which sites touch.
    void land(double from) {
        const double at = time_;
        std::vector<int> changed(held_.size()), directions(held_.size());
        check(ERKStepGetRootInfo(ark_, changed.data()), "ERKStepGetRootInfo");
        landing_ = true;
        N_VScale(1.0, before_, state_);
        check(ERKStepReset(ark_, from, state_), "ERKStepReset");
        check(ERKStepSetStopTime(ark_, at), "ERKStepSetStopTime");
        do check(ERKStepEvolve(ark_, at, state_, &time_, ARK_ONE_STEP), "ERKStepEvolve");
        while (time_ < at);
        landing_ = false;
        for (std::size_t i = 0; i < held_.size(); ++i) {
            const Site &site = lattice_.sites()[i];
            if (changed[i]) held_[i] = held_[i] ? 0 : (state()[site.resonator] > state()[site.host] ? 1 : -1);
            directions[i] = held_[i] ? -1 : 1;
        }
        check(ERKStepSetRootDirection(ark_, directions.data()), "ERKStepSetRootDirection");
        check(ERKStepReset(ark_, at, state_), "ERKStepReset");
    }
};

static void solve(const Lattice &lattice, const char *method, double rtol, double atol, const std::string &output) {
    Samples samples(lattice);
    long steps = 0, evaluations = 0;
    const double begin = cpu_seconds();
    Solver solver(lattice, method, rtol, atol);
    for (double time : sample_times(lattice)) {
        solver.advance(time);
        samples.keep(solver.state());
    }
    const double seconds = cpu_seconds() - begin;
    solver.counts(steps, evaluations);
    samples.write(output);
    report(seconds, steps, evaluations);
}

int main(int argc, char **argv) {
    if (argc != 6) {
        std::cerr << "usage: arkode PARAMETERS TABLE RTOL ATOL OUTPUT\n";
        return 2;
    }
    try {
        solve(Lattice(argv[1]), argv[2], std::atof(argv[3]), std::atof(argv[4]), argv[5]);
    } catch (const std::exception &error) {
        std::cerr << "arkode: " << error.what() << "\n";
        return 1;
    }
    return 0;
}
