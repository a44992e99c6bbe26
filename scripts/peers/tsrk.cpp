// Peer: PETSc's TSRK as its manual uses it, solved from sample to sample, no events.
// tsrk PARAMETERS METHOD RTOL ATOL OUTPUT, METHOD a TSRKType; ATOL in units of the drive's linear wave.
#include <cstdlib>
#include <exception>
#include <iostream>

#include <petscts.h>

#include "lattice.hpp"

struct Context {
    const Lattice &lattice;
    long evaluations;
};

static PetscErrorCode right_hand_side(TS, PetscReal t, Vec y, Vec f, void *pointer) {
    auto *context = static_cast<Context *>(pointer);
    const PetscScalar *from;
    PetscScalar *to;
    PetscFunctionBeginUser;
    ++context->evaluations;
    PetscCall(VecGetArrayRead(y, &from));
    PetscCall(VecGetArrayWrite(f, &to));
    context->lattice.derivative(from, to, t);
    PetscCall(VecRestoreArrayWrite(f, &to));
    PetscCall(VecRestoreArrayRead(y, &from));
    PetscFunctionReturn(0);
}

static PetscErrorCode solve(const Lattice &lattice, const char *method, double rtol, double atol, const char *output) {
    Context context{lattice, 0};
    Samples samples(lattice);
    const std::vector<double> times = sample_times(lattice);
    TS ts;
    Vec state;
    PetscInt steps;
    PetscFunctionBeginUser;
    const double begin = cpu_seconds();
    PetscCall(VecCreateSeq(PETSC_COMM_SELF, lattice.size(), &state));
    PetscCall(TSCreate(PETSC_COMM_SELF, &ts));
    PetscCall(TSSetProblemType(ts, TS_NONLINEAR));
    PetscCall(TSSetType(ts, TSRK));
    PetscCall(TSRKSetType(ts, method));
    PetscCall(TSSetRHSFunction(ts, nullptr, right_hand_side, &context));
    PetscCall(TSSetTolerances(ts, atol, nullptr, rtol, nullptr));
    PetscCall(TSSetTimeStep(ts, 2e-3));
    PetscCall(TSSetMaxSteps(ts, PETSC_MAX_INT));
    PetscCall(TSSetMaxStepRejections(ts, -1));
    PetscCall(TSSetExactFinalTime(ts, TS_EXACTFINALTIME_MATCHSTEP));
    PetscCall(TSSetFromOptions(ts));
    for (double time : times) {
        const PetscScalar *values;
        if (time > 0) {
            PetscCall(TSSetMaxTime(ts, time));
            PetscCall(TSSolve(ts, state));
        }
        PetscCall(VecGetArrayRead(state, &values));
        samples.keep(values);
        PetscCall(VecRestoreArrayRead(state, &values));
    }
    const double seconds = cpu_seconds() - begin;
    PetscCall(TSGetStepNumber(ts, &steps));
    samples.write(output);
    report(seconds, steps, context.evaluations);
    PetscCall(TSDestroy(&ts));
    PetscCall(VecDestroy(&state));
    PetscFunctionReturn(0);
}

int main(int argc, char **argv) {
    if (argc != 6) {
        std::cerr << "usage: tsrk PARAMETERS METHOD RTOL ATOL OUTPUT\n";
        return 2;
    }
    PetscCall(PetscInitialize(&argc, &argv, nullptr, nullptr));
    // Of the two norms of the error this one costs less at equal error here.
    PetscCall(PetscOptionsSetValue(nullptr, "-ts_adapt_wnormtype", "infinity"));
    try {
        const Lattice lattice(argv[1]);
        PetscCall(solve(lattice, argv[2], std::atof(argv[3]), std::atof(argv[4]), argv[5]));
    } catch (const std::exception &error) {
        std::cerr << "tsrk: " << error.what() << "\n";
        return 1;
    }
    return PetscFinalize();
}
