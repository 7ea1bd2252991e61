#include "factors.h"

namespace fleetmap {
namespace {

template <int kRows, int kColumns>
void put(Linear<kRows, kColumns>& to, int row, int column, const Mat3& part) {
  store(part, &to.jacobian[row][column], kColumns);
}

}  // namespace

Linear<6, 6> pose_prior(const SE3& map_from_body, const SE3& measured) {
  Linear<6, 6> out = {};
  const Vec3 turn = so3_log(map_from_body.rotation * transposed(measured.rotation));
  store(turn, out.residual);
  store(map_from_body.translation - measured.translation, out.residual + 3);
  put(out, 0, 0, inverse_left_jacobian(turn));
  put(out, 3, 3, kIdentity);
  return out;
}

Linear<6, 13> relative_pose(const SE3& map_from_i, const SE3& map_from_j, const SE3& i_from_j, Vec3 way) {
  Linear<6, 13> out = {};
  const Mat3 i_from_map = transposed(map_from_i.rotation);
  const Vec3 apart = map_from_j.translation - map_from_i.translation;
  const Vec3 turn = so3_log(i_from_map * map_from_j.rotation * transposed(i_from_j.rotation));
  store(turn, out.residual);
  store(i_from_map * apart - i_from_j.translation, out.residual + 3);
  const Mat3 turned = inverse_left_jacobian(turn) * i_from_map;
  put(out, 0, 0, -1.0 * turned), put(out, 0, 6, turned);
  put(out, 3, 0, i_from_map * skew(apart));
  put(out, 3, 3, -1.0 * i_from_map), put(out, 3, 9, i_from_map);
  for (int a = 0; a < 3; ++a) out.jacobian[3 + a][12] = -way[a];
  return out;
}

Linear<15, 30> inertial_edge(const Moment& i, const Moment& j, Vec3 gravity, const double* increments) {
  const double dt = increments[0];
  const Mat3 delta_rotation = mat3(increments + 1), rotation_by_gyro = mat3(increments + 16), velocity_by_gyro = mat3(increments + 25),
             velocity_by_accel = mat3(increments + 34), position_by_gyro = mat3(increments + 43), position_by_accel = mat3(increments + 52);
  const Vec3 delta_velocity = vec3(increments + 10), delta_position = vec3(increments + 13);
  const Vec3 gyro = i.gyro_bias - vec3(increments + 61), accel = i.accel_bias - vec3(increments + 64);  // changes of the biases
  const Mat3 i_from_map = transposed(i.map_from_body.rotation);
  const Vec3 bend = rotation_by_gyro * gyro;
  const Mat3 off = transposed(delta_rotation * so3_exp(bend)) * (i_from_map * j.map_from_body.rotation);
  const Vec3 turn = so3_log(off);
  const Vec3 faster = j.velocity - i.velocity - dt * gravity;
  Vec3 farther;  // p_j - p_i - v_i dt - g dt^2 / 2
  for (int a = 0; a < 3; ++a)
    farther[a] = j.map_from_body.translation[a] - i.map_from_body.translation[a] - i.velocity[a] * dt - 0.5 * gravity[a] * dt * dt;
  Linear<15, 30> out = {};
  store(turn, out.residual);
  store(i_from_map * faster - (velocity_by_gyro * gyro + delta_velocity) - velocity_by_accel * accel, out.residual + 3);
  store(i_from_map * farther - (position_by_gyro * gyro + delta_position) - position_by_accel * accel, out.residual + 6);
  store(j.gyro_bias - i.gyro_bias, out.residual + 9);
  store(j.accel_bias - i.accel_bias, out.residual + 12);

  const Mat3 inverse_right_jacobian = transposed(inverse_left_jacobian(turn));
  const Mat3 turned = inverse_right_jacobian * transposed(j.map_from_body.rotation);
  put(out, 0, 0, -1.0 * turned), put(out, 0, 15, turned);
  put(out, 0, 9, -1.0 * (inverse_right_jacobian * (transposed(off) * (right_jacobian(bend) * rotation_by_gyro))));
  put(out, 3, 0, i_from_map * skew(faster));
  put(out, 3, 6, -1.0 * i_from_map), put(out, 3, 21, i_from_map);
  put(out, 3, 9, -1.0 * velocity_by_gyro), put(out, 3, 12, -1.0 * velocity_by_accel);
  put(out, 6, 0, i_from_map * skew(farther));
  put(out, 6, 3, -1.0 * i_from_map), put(out, 6, 18, i_from_map);
  put(out, 6, 6, -dt * i_from_map);
  put(out, 6, 9, -1.0 * position_by_gyro), put(out, 6, 12, -1.0 * position_by_accel);
  for (int a = 0; a < 6; ++a) out.jacobian[9 + a][9 + a] = -1.0, out.jacobian[9 + a][24 + a] = 1.0;
  return out;
}

}  // namespace fleetmap
