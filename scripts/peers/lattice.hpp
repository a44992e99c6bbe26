// The contact lattice that the peers in C++ solve: read from the bench's parameter file, in units of the drive's linear
// wave.
//
// Displacements are in units of that wave's amplitude, times in units of 1/Om. Displacements and velocities are then of
// one size, which a solver with a single absolute tolerance needs.
#pragma once

#include <array>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

struct Coupling {
    int mass, offset, other;
    double stiffness;  // divided by the mass
};

struct Site {
    int host, resonator;  // indices of the two displacements
    double clearance;
};

// State: all displacements mass by mass, then all velocities likewise; every inner loop is contiguous.
class Lattice {
  public:
    int cells = 0, dofs = 0, samples = 0;
    double interval = 0, rate = 0, scale = 0;  // sample interval (s), Om (rad/s), the wave's displacement (m)

    explicit Lattice(const std::string &path) {
        std::ifstream file(path);
        if (!file) throw std::runtime_error("cannot read " + path);
        int couplings = 0, sites = 0, hertz = 0, host = 0, resonator = 0, driven_cell = 0, driven_mass = 0;
        double contact = 0, amplitude = 0, frequency = 0;
        expect(file, "lattice") >> cells >> dofs >> walls_;
        expect(file, "sampling") >> samples >> interval;
        expect(file, "scale") >> scale >> rate;
        masses_.resize(dofs);
        for (double &mass : expect_each(file, "masses", masses_)) mass *= rate * rate;
        expect(file, "couplings") >> couplings;
        couplings_.resize(dofs);
        for (int i = 0; i < couplings; ++i) {
            Coupling c;
            file >> c.mass >> c.offset >> c.other >> c.stiffness;
            c.stiffness /= masses_.at(c.mass);
            couplings_.at(c.mass).push_back(c);
        }
        expect(file, "contact") >> hertz >> contact >> host >> resonator;
        hertz_ = hertz != 0;
        contact_ = hertz_ ? contact * std::sqrt(scale) : contact;
        per_host_ = 1 / masses_.at(host);
        per_resonator_ = 1 / masses_.at(resonator);
        expect(file, "sites") >> sites;
        for (int i = 0; i < sites; ++i) {
            int cell = 0;
            double clearance = 0;
            file >> cell >> clearance;
            sites_.push_back({host * cells + cell, resonator * cells + cell, clearance / scale});
        }
        expect(file, "drive") >> driven_cell >> driven_mass >> amplitude >> frequency >> cycles_;
        if (!file) throw std::runtime_error(path + " ends early");
        driven_ = driven_mass * cells + driven_cell;
        drive_ = amplitude / (scale * masses_.at(driven_mass));
        drive_rate_ = frequency / rate;
    }

    int size() const { return 2 * dofs * cells; }

    const std::vector<Site> &sites() const { return sites_; }

    // Time derivative of y at time t; allocates nothing. With `held`, that says for each site whether it touches and on
    // which side (0, 1, -1), and the force goes on smoothly where the masses would part.
    void derivative(const double *__restrict y, double *__restrict f, double t, const signed char *held = nullptr) const {
        const int half = dofs * cells;
        double *acceleration = f + half;
        for (int i = 0; i < half; ++i) f[i] = y[half + i];
        for (int mass = 0; mass < dofs; ++mass) {
            double *out = acceleration + mass * cells;
            const auto &row = couplings_[mass];
            switch (row.size()) {
            case 1: interior<1>(y, out, mass); break;
            case 2: interior<2>(y, out, mass); break;
            case 3: interior<3>(y, out, mass); break;
            case 4: interior<4>(y, out, mass); break;
            default:
                for (int cell = 1; cell < cells - 1; ++cell) out[cell] = pull(y, mass, cell);
            }
            out[0] = pull(y, mass, 0);
            out[cells - 1] = pull(y, mass, cells - 1);
        }
        for (const Site &site : sites_) {
            const double w = y[site.resonator] - y[site.host];
            const int side = held ? *held++ : (w > 0 ? 1 : -1);
            const double x = side * w - site.clearance;
            if (held ? side != 0 : x > 0) {
                const double force = side * contact_ * (hertz_ ? x * std::sqrt(std::abs(x)) : x);
                acceleration[site.host] += force * per_host_;
                acceleration[site.resonator] -= force * per_resonator_;
            }
        }
        const double phase = drive_rate_ * t;
        if (phase > 0 && phase < 2 * M_PI * cycles_)
            acceleration[driven_] += drive_ * (1 - std::cos(phase / cycles_)) * std::sin(phase);
    }

  private:
    int walls_ = 0, driven_ = 0;
    bool hertz_ = false;
    double contact_ = 0, per_host_ = 0, per_resonator_ = 0, drive_ = 0, drive_rate_ = 0, cycles_ = 0;
    std::vector<double> masses_;
    std::vector<std::vector<Coupling>> couplings_;
    std::vector<Site> sites_;

    static std::ifstream &expect(std::ifstream &file, const std::string &key) {
        std::string found;
        file >> found;
        if (found != key) throw std::runtime_error("expected '" + key + "', found '" + found + "'");
        return file;
    }

    static std::vector<double> &expect_each(std::ifstream &file, const std::string &key, std::vector<double> &values) {
        expect(file, key);
        for (double &value : values) file >> value;
        return values;
    }

    // Acceleration of one mass by its springs, walls and free ends included.
    double pull(const double *y, int mass, int cell) const {
        double total = 0;
        for (const Coupling &c : couplings_[mass]) {
            const int neighbour = cell + c.offset;
            const bool outside = neighbour < 0 || neighbour >= cells;
            if (outside && !walls_) continue;
            total += c.stiffness * ((outside ? 0.0 : y[c.other * cells + neighbour]) - y[mass * cells + cell]);
        }
        return total;
    }

    // The same for all cells but the two at the ends, in one pass over S springs.
    template <int S> void interior(const double *__restrict y, double *__restrict out, int mass) const {
        std::array<const double *, S> other;
        std::array<double, S> stiffness;
        for (int s = 0; s < S; ++s) {
            const Coupling &c = couplings_[mass][s];
            other[s] = y + c.other * cells + c.offset;
            stiffness[s] = c.stiffness;
        }
        const double *own = y + mass * cells;
        for (int cell = 1; cell < cells - 1; ++cell) {
            double total = 0;
            for (int s = 0; s < S; ++s) total += stiffness[s] * (other[s][cell] - own[cell]);
            out[cell] = total;
        }
    }
};

// Velocities at the sample times, kept in memory and written as doubles in m/s when all is done.
class Samples {
  public:
    explicit Samples(const Lattice &lattice)
        : half_(lattice.dofs * lattice.cells), unit_(lattice.scale * lattice.rate),
          values_(static_cast<std::size_t>(half_) * lattice.samples) {}

    void keep(const double *state) {
        for (int i = 0; i < half_; ++i) values_[at_ + i] = unit_ * state[half_ + i];
        at_ += half_;
    }

    void write(const std::string &path) const {
        std::ofstream file(path, std::ios::binary);
        file.write(reinterpret_cast<const char *>(values_.data()), at_ * sizeof(double));
        if (!file) throw std::runtime_error("cannot write " + path);
    }

  private:
    int half_;
    double unit_;
    std::size_t at_ = 0;
    std::vector<double> values_;
};

inline std::vector<double> sample_times(const Lattice &lattice) {
    std::vector<double> times(lattice.samples);
    for (int k = 0; k < lattice.samples; ++k) times[k] = k * lattice.interval * lattice.rate;
    return times;
}

inline double cpu_seconds() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

inline void report(double seconds, long steps, long evaluations) {
    std::printf("{\"cpu_seconds\": %.6f, \"steps\": %ld, \"evaluations\": %ld}\n", seconds, steps, evaluations);
}
