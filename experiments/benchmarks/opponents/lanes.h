/* The published model, Eqs. (1)-(9), by forward Euler, for LANES flights at a time: loops over lanes vectorise.

   The order of the states puts first what depends on nothing after it: p, q, r, phi, theta, psi, vx, vy, vz, x, y, z.
   The rates alone are the first three. With one lane, loops over unknowns vectorise instead. */
#include <math.h>

#ifndef LANES
#define LANES 8
#endif
enum { STATES = 12, RATES = 3, PARAMETERS = 8, COEFFICIENTS = 29 };
typedef double Lanes[LANES];

#define INLINE static inline __attribute__((always_inline))
#define SIMD _Pragma("omp simd")
#if LANES == 1
#define EACH_LANE for (int l = 0; l < 1; l++)
#define EACH_UNKNOWN(j, from, to) SIMD for (int j = from; j < to; j++)
#else
#define EACH_LANE SIMD for (int l = 0; l < LANES; l++)
#define EACH_UNKNOWN(j, from, to) for (int j = from; j < to; j++)
#endif

/* x = turns pi + r, |r| <= pi / 2; Taylor polynomials of r, accurate to 1e-11. */
INLINE void sines(double x, double *sine, double *cosine)
{
    double turns = rint(x * 0.31830988618379067154);
    double r = x - turns * 3.14159265358979311600 - turns * 1.22464679914735317636e-16, r2 = r * r;
    double sign = 1.0 - 2.0 * (turns - 2.0 * floor(0.5 * turns));
    double s = -7.6471637318198164759e-13, c = 4.7794773323873852974e-14;
    s = s * r2 + 1.6059043836821614599e-10, c = c * r2 - 1.1470745597729724714e-11;
    s = s * r2 - 2.5052108385441718775e-8, c = c * r2 + 2.0876756987868098979e-9;
    s = s * r2 + 2.7557319223985890653e-6, c = c * r2 - 2.7557319223985890653e-7;
    s = s * r2 - 1.9841269841269841270e-4, c = c * r2 + 2.4801587301587301587e-5;
    s = s * r2 + 8.3333333333333333333e-3, c = c * r2 - 1.3888888888888888889e-3;
    s = s * r2 - 1.6666666666666666667e-1, c = c * r2 + 4.1666666666666666667e-2;
    s = s * r2 + 1.0, c = c * r2 - 0.5;
    *sine = sign * r * s;
    *cosine = sign * (c * r2 + 1.0);
}

/* The factors of the coefficients of `advance`, for tangents in multiples of 1 / weights. */
INLINE void scale_coefficients(double dt, const double *weights, double *factors)
{
    static const int row[COEFFICIENTS] = {0, 0, 1, 1, 2, 2, 3, 3, 3, 3, 3, 4, 4, 4, 5,
                                          5, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 9, 10, 11};
    static const int column[COEFFICIENTS] = {1, 2, 0, 2, 0, 1, 3, 4, 0, 1, 2, 3, 1, 2, 3,
                                             4, 1, 2, 3, 4, 5, 3, 4, 5, 3, 4, 6, 7, 8};
    for (int i = 0; i < COEFFICIENTS; i++)
        factors[i] = dt * weights[row[i]] / weights[column[i]];
}

/* The next state. With `factors`, also the coefficients `c` of its tangents, and `f`: the derivatives of the rates'
   change with respect to each parameter. */
INLINE void advance(const int states, double dt, double gravity, const double *u, const Lanes *a, Lanes *s,
                    const double *factors, Lanes *c, Lanes *f)
{
    EACH_LANE
    {
        double p = s[0][l], q = s[1][l], r = s[2][l];
        s[0][l] = p + dt * (q * r * a[0][l] - a[1][l] * q + a[2][l] * u[0]);
        s[1][l] = q + dt * (p * r * a[3][l] + r * a[4][l] + a[5][l] * u[1]);
        s[2][l] = r + dt * (p * q * a[6][l] + a[7][l] * u[2]);
        if (factors) {
            c[0][l] = factors[0] * (r * a[0][l] - a[1][l]), c[1][l] = factors[1] * q * a[0][l];
            c[2][l] = factors[2] * r * a[3][l], c[3][l] = factors[3] * (p * a[3][l] + a[4][l]);
            c[4][l] = factors[4] * q * a[6][l], c[5][l] = factors[5] * p * a[6][l];
            f[0][l] = q * r, f[1][l] = -q, f[2][l] = u[0];
            f[3][l] = p * r, f[4][l] = r, f[5][l] = u[1];
            f[6][l] = p * q, f[7][l] = u[2];
        }
        if (states == STATES) {
            double phi = s[3][l], theta = s[4][l], psi = s[5][l], sf, cf, st, ct, sp, cp, thrust = u[3];
            sines(phi, &sf, &cf), sines(theta, &st, &ct), sines(psi, &sp, &cp);
            double secant = 1.0 / ct, tangent = st * secant, turning = q * sf + r * cf, across = q * cf - r * sf;
            double ax = (sf * cp - sp * st * cf) * thrust, ay = (-sp * sf - st * cf * cp) * thrust;
            double az = ct * cf * thrust;
            s[9][l] += dt * s[6][l], s[10][l] += dt * s[7][l], s[11][l] += dt * s[8][l];
            s[6][l] += dt * ax, s[7][l] += dt * ay, s[8][l] += dt * (az - gravity);
            s[3][l] = phi + dt * (p + tangent * turning);
            s[4][l] = theta + dt * across;
            s[5][l] = psi + dt * turning * secant;
            if (factors) {
                c[6][l] = factors[6] * tangent * across, c[7][l] = factors[7] * secant * secant * turning;
                c[8][l] = factors[8], c[9][l] = factors[9] * tangent * sf, c[10][l] = factors[10] * tangent * cf;
                c[11][l] = -factors[11] * turning, c[12][l] = factors[12] * cf, c[13][l] = -factors[13] * sf;
                c[14][l] = factors[14] * across * secant, c[15][l] = factors[15] * turning * secant * tangent;
                c[16][l] = factors[16] * sf * secant, c[17][l] = factors[17] * cf * secant;
                c[18][l] = factors[18] * (cf * cp + sp * st * sf) * thrust;
                c[19][l] = -factors[19] * sp * az, c[20][l] = factors[20] * ay;
                c[21][l] = factors[21] * (-sp * cf + st * sf * cp) * thrust;
                c[22][l] = -factors[22] * cp * az, c[23][l] = -factors[23] * ax;
                c[24][l] = -factors[24] * ct * sf * thrust, c[25][l] = -factors[25] * st * cf * thrust;
            }
        }
    }
}

/* The next tangent `j` of `t`: (STATES, tangents, LANES), without what the parameters add. */
INLINE void advance_tangent(const int states, const int tangents, int j, const double *factors, const Lanes *c,
                            Lanes *t)
{
#define T(state) t[(state) * tangents + j][l]
    EACH_LANE
    {
        double p = T(0), q = T(1), r = T(2);
        T(0) = p + c[0][l] * q + c[1][l] * r;
        T(1) = q + c[2][l] * p + c[3][l] * r;
        T(2) = r + c[4][l] * p + c[5][l] * q;
        if (states == STATES) {
            double phi = T(3), theta = T(4), psi = T(5);
            T(9) += factors[26] * T(6), T(10) += factors[27] * T(7), T(11) += factors[28] * T(8);
            T(6) += c[18][l] * phi + c[19][l] * theta + c[20][l] * psi;
            T(7) += c[21][l] * phi + c[22][l] * theta + c[23][l] * psi;
            T(8) += c[24][l] * phi + c[25][l] * theta;
            T(3) = phi + c[6][l] * phi + c[7][l] * theta + c[8][l] * p + c[9][l] * q + c[10][l] * r;
            T(4) = theta + c[11][l] * phi + c[12][l] * q + c[13][l] * r;
            T(5) = psi + c[14][l] * phi + c[15][l] * theta + c[16][l] * q + c[17][l] * r;
        }
    }
#undef T
}
